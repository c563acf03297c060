"""The soak itself, for some seconds: everything at once against the real koop-serve."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from matplotlib import image
from soaking.roles import Answers
from soaking.verdict import TROUBLE, Sample, Verdict, judge

from koop_protocol import StateReply

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_short_soak_loses_nothing_and_says_so(tmp_path: Path) -> None:
    """How fast it was is not looked at; everything else must be right at any speed."""
    picture = tmp_path / "folder" / "soak.png"
    command = [sys.executable, str(ROOT / "benchmarks" / "soak.py"), "--json", "--out", picture]
    command += ["--minutes", "0.15", "--sources", "2", "--life", "4", "--spoilt", "40"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=280)
    assert "Traceback" not in done.stderr, done.stderr
    verdict = json.loads(done.stdout.splitlines()[-1])
    assert verdict["frames"] > 0
    assert verdict["starts"] > 2, "no source restarted"
    assert (verdict["lost"], verdict["stream_trouble"], verdict["unanswered"]) == (0, 0, 0)
    assert (verdict["internal_errors"], verdict["exit_code"], verdict["refused"]) == (0, 0, {})
    assert 0 < verdict["rejected"] <= verdict["spoilt"]
    assert verdict["sound"] == (done.returncode == 0) == ("NOT sound" not in done.stdout)
    assert image.imread(picture).std() > 0


def judged(growth: float = 0.0, folded: int = 100, lost: float = 0.0, code: str = "") -> Verdict:
    """Twenty minutes of one source; memory grows by `growth` [bytes/min]."""
    samples = [Sample(60.0 * i, 400_000_000 + int(growth * i), i, i, lost, 0.0) for i in range(21)]
    answers = Answers(2, Counter(["", code]), [(0.0, 0.005)])
    found = {
        "frames": {"a": 100},
        "starts": 2,
        "answers": answers,
        "spoilt": 9,
        "spoilt_answers": Answers(),
        "commands": Counter(commands=1, begun=1),
    }
    counters = {"frames": folded, **dict.fromkeys(TROUBLE, 0)}
    sizes = {"code_size": 8, "history": 2, "control_size": 1, "warmup_frames": 36}
    state = StateReply(
        "a", "0" * 16, 50, "m", frames=50, updates=48, ready=True, residual_rms=0.0,
        spectral_radius=0.0, excitation=0.0, counters=counters, **sizes,
    )  # fmt: skip
    return judge(20.0, samples, found, {"a": state}, 0)


def test_a_verdict_names_what_is_wrong() -> None:
    assert judged().sound
    assert judged(growth=1e6).sound
    assert judged(growth=3e6).why == ["memory grows"]
    assert judged(folded=99).why == ["frames were lost"]
    assert judged(lost=1.0).why == ["the service lost messages by a fault of its own"]
    assert judged(code="warming_up").sound
    assert judged(code="bad_horizon").why == ["good questions were refused"]
    assert "there were internal errors" in judged(code="internal").why
    assert judged(code="overloaded").why == ["too many questions waited"]
