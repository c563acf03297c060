"""The soak itself, for some seconds: everything at once against the real koop-serve."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib import image

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
