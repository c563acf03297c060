"""A killed training goes on with the same bits; another training's checkpoint is refused."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from koop_service.encoding.weights import load_weights
from koop_service.learning import cli
from koop_service.learning.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from koop_service.learning.hardware import choose
from koop_service.learning.train import Setting, advance, begin

from .blobs import smoke

STEPS = {"warm_up": 12, "steps": 12}


def arguments(recording: Path, out: Path, **changes) -> cli.Arguments:
    return cli.Arguments(recording, out, preset="smoke", threads=1, **{**STEPS, **changes})


def command(recording: Path, out: Path) -> list[str]:
    options = [f"--{name.replace('_', '-')}={value}" for name, value in STEPS.items()]
    start = [sys.executable, "-m", "koop_service.learning.cli", str(recording), "--out", str(out)]
    return [*start, "--preset=smoke", "--threads=1", "--checkpoint-seconds=0", *options]


def kill_in(stage: int, recording: Path, out: Path, number: int) -> subprocess.Popen:
    """Start the command, and signal it once it has written a checkpoint in `stage` or later."""
    before = _written(out)[0]
    process = subprocess.Popen(command(recording, out), stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 100
    while _written(out)[0] == before or _written(out)[1] < stage:
        assert process.poll() is None, f"it ended by itself: {process.stderr.read()}"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(number)
    return process


def _written(out: Path) -> tuple[int, int]:
    """When the checkpoint was written [ns], and its stage; nothing is older than anything."""
    path = checkpoint_path(out)
    try:
        with safe_open(path, "pt") as file:
            stage = json.loads(file.metadata()["state"])["stage"]
        return path.stat().st_mtime_ns, stage
    except (OSError, RuntimeError):  # none yet, or replaced while it was read
        return 0, -1


def same(a: Path, b: Path) -> bool:
    first, second = (load_weights(path)[0].state_dict() for path in (a, b))
    return all(torch.equal(first[name], second[name]) for name in first)


@pytest.fixture(scope="module")
def undisturbed(recording_file, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "whole.safetensors"
    cli.run(arguments(recording_file, out))
    return out


def test_killed_twice_it_ends_with_the_same_bits(recording_file, undisturbed, tmp_path, capsys):
    out = tmp_path / "killed.safetensors"
    for stage in (0, 1):
        process = kill_in(stage, recording_file, out, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert not out.exists()
    cli.run(arguments(recording_file, out))
    assert "going on from" in capsys.readouterr().err
    assert same(out, undisturbed)
    with out.with_suffix(".csv").open(newline="") as file:
        rows = [(row["stage"], int(row["step"])) for row in csv.DictReader(file)]
    assert rows == [("autoencoder", 12), ("dynamics", 12)]
    assert not checkpoint_path(out).exists()


def test_a_signal_stops_it_with_a_checkpoint(recording_file, undisturbed, tmp_path):
    out = tmp_path / "stopped.safetensors"
    process = kill_in(0, recording_file, out, signal.SIGTERM)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert "the same command goes on there" in told
    cli.run(arguments(recording_file, out))
    assert same(out, undisturbed)


@pytest.mark.parametrize("stop", range(0, 7, 2))
def test_every_step_can_be_gone_on_from(recording, tmp_path, stop):
    """Also without a process: 3 steps of each stage, stopped after `stop` of them."""
    setting, path = Setting(recording, smoke(), 2, choose("cpu")), tmp_path / "c"
    whole = begin(setting, "learned-A")
    list(advance(whole, setting))
    part = begin(setting, "learned-A")
    for _ in zip(range(stop), advance(part, setting), strict=False):
        pass
    save_checkpoint(path, part, {})
    resumed = begin(setting, "learned-A")
    load_checkpoint(path, resumed, {})
    assert resumed.frames == part.frames
    list(advance(resumed, setting))
    first, second = whole.model.state_dict(), resumed.model.state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert torch.equal(whole.dynamics.matrix, resumed.dynamics.matrix)


@pytest.fixture
def unfinished(recording_file, tmp_path) -> Path:
    out = tmp_path / "unfinished.safetensors"
    process = kill_in(0, recording_file, out, signal.SIGKILL)
    process.wait()
    return out


def test_other_arguments_are_refused(recording_file, unfinished):
    with pytest.raises(ValueError, match=r"other arguments \(seed: 0 then, 9 now\).*--fresh"):
        cli.run(arguments(recording_file, unfinished, seed=9))
    cli.run(arguments(recording_file, unfinished, seed=9, steps=1, warm_up=1, fresh=True))
    assert load_weights(unfinished)[1].training["seed"] == 9


def test_a_broken_checkpoint_is_told(recording_file, tmp_path):
    out = tmp_path / "broken.safetensors"
    checkpoint_path(out).write_bytes(os.urandom(100))
    with pytest.raises(ValueError, match=r"cannot be read.*--fresh starts over"):
        cli.run(arguments(recording_file, out))
