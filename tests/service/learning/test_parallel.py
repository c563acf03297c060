"""Two processes under torchrun: the same weights in both, and the loss falls."""

import csv
import subprocess
import sys

import pytest
import torch

from koop_service.encoding.weights import load_weights
from koop_service.learning.parallel import Group

SCRIPT = """
import sys
from pathlib import Path
import torch
from safetensors.torch import save_file
from koop_service.learning import cli, session

keep = session.Session.run

def run(self):
    keep(self)
    state = {k: v.contiguous() for k, v in self.training.model.state_dict().items()}
    save_file(state, f"{sys.argv[1]}.{self.setting.group.rank}")

session.Session.run = run
recording, out = Path(sys.argv[2]), Path(sys.argv[3])
torch.set_num_threads(1)
cli.run(cli.Arguments(recording, out, preset="smoke", device="cpu", warm_up=40, steps=3))
"""


def test_two_processes_agree_bit_for_bit_and_learn(recording_file, tmp_path):
    script, out = tmp_path / "two.py", tmp_path / "two.safetensors"
    script.write_text(SCRIPT)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2"]
    files = [str(path) for path in (script, tmp_path / "rank", recording_file, out)]
    done = subprocess.run(
        [*torchrun, "--standalone", *files],
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    from safetensors.torch import load_file

    first, second = (load_file(tmp_path / f"rank.{rank}") for rank in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert all(torch.equal(first[k], v) for k, v in load_weights(out)[0].state_dict().items())
    with out.with_suffix(".csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert int(rows[0]["frames"]) == 40 * 16
    assert float(rows[-1]["reconstruction"]) < float(rows[0]["reconstruction"])


@pytest.mark.parametrize(("batch", "size", "share"), [(8, 1, 8), (8, 2, 4), (9, 2, 5), (1, 4, 1)])
def test_shares_of_a_batch(batch, size, share):
    assert Group(0, size).share(batch) == share


def test_alone_nothing_is_averaged():
    tensor = torch.ones(3)
    Group().average([tensor])
    assert torch.equal(tensor, torch.ones(3))
    assert Group().any(True)
