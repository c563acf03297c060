"""`koop-eval control` from end to end, on two starts: real processes, real Zenoh."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from koop_service.evaluation.control import command, study, trials
from koop_service.evaluation.control.command import Control


@pytest.mark.slow
def test_every_method_drives_and_everything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(trials, "LEARN", 14.0)
    monkeypatch.setattr(trials, "DRIVE", 4.5)
    monkeypatch.setattr(study, "CHANGE_AT", 1.5)
    wanted = Control(("cartpole",), starts=2, together=2, out=tmp_path, rate="max", json=True)
    command.run(wanted)
    (found,) = json.loads(capsys.readouterr().out.splitlines()[-1]).values()
    assert found["mpc"]["success_rate"] == 1.0
    assert found["state-lqr"]["cost_ratio"] == 1.0
    assert found["mpc"]["cost_ratio"] < 2.0
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "report.md",
        "table.csv",
        "change-of-mass.png",
        "figure-06.png",
        "cartpole-actuated-ways.png",
        "cartpole-actuated-film.gif",
    }


def test_no_starts_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--starts is 0"):
        command.run(Control(starts=0, out=tmp_path))
