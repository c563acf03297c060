"""`koop-eval fluid-control`: what is told of many wakes, and the whole from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from koop_service.evaluation.fluid.control import command, report, trials
from koop_service.evaluation.fluid.control.command import FluidControl
from koop_service.evaluation.fluid.control.figures import draw_strip, draw_swings, save_film
from koop_service.evaluation.fluid.control.methods import METHODS
from koop_service.evaluation.fluid.control.trials import Protocol, Trials


def made_up(decay: float, frames: int = 200) -> Trials:
    """Two wakes whose swing falls by `decay` a frame."""
    k = np.arange(frames)
    probes = 0.2 * decay**k * np.sin(2 * np.pi * k / 9 + np.array([[0.0], [1.0]]))
    calmed = [None, None] if decay == 1 else [50, 70]
    return Trials(
        probes=probes,
        rotations=np.full_like(probes, 0.1),
        natural=0.2,
        momenta=np.ones((frames, 8, 16), np.float32),
        target=np.ones((8, 16), np.float32),
        calmed=calmed,
        success=[frames is not None for frames in calmed],
        p50=0.01,
        p99=0.02,
    )


FOUND = {"mpc": made_up(0.95), "rest": replace(made_up(1.0), p50=None, p99=None)}


def test_swings_are_told_over_the_natural_one() -> None:
    found = report.as_json(FOUND)
    assert found["mpc"]["calmed"] == 2
    assert found["mpc"]["frames_to_calm"] == 60
    assert found["mpc"]["swing_after_150"] == pytest.approx(0.95**150, rel=0.2)
    assert found["rest"]["frames_to_calm"] is None
    assert found["rest"]["swing_at_end"] == pytest.approx(1.0, rel=0.02)
    assert found["rest"]["effort"] == pytest.approx(0.1)
    swings = FOUND["rest"].swings()
    assert swings.shape == (2, 200)
    assert swings.min() > 0.9


def test_the_page_has_every_method() -> None:
    page = report.markdown(FOUND, Protocol(wakes=2), 0.42, "koop-eval fluid-control")
    assert "| ours, receding horizon (eq. 13) | 2 of 2 | 60 |" in page
    assert "| no control | 0 of 2 | never |" in page
    assert "swings by 0.200 U" in page
    assert "simulated time waits" in page
    assert [row[:3] for row in report.rows(FOUND)] == [("mpc", 2, 2), ("rest", 2, 0)]


def test_a_service_that_drove_no_wake_is_told_too(tmp_path: Path) -> None:
    saved = {name: np.zeros((2, 0)) for name in ("probes", "rotations")}
    saved |= {"natural": np.array(0.2), "momenta": np.zeros((0, 8, 16)), "target": np.ones((8, 16))}
    drive = {"outcome": None, "command": None}
    found = {"mpc": trials.told_of({"drives": [drive, drive]}, saved)}
    numbers = report.as_json(found)["mpc"]
    assert (numbers["calmed"], numbers["frames_to_calm"], numbers["effort"]) == (0, None, 0)
    assert numbers["swing_after_150"] == numbers["swing_at_end"] == 1
    page = report.markdown(found, Protocol(wakes=2), 0.42, "koop-eval fluid-control")
    assert "| ours, receding horizon (eq. 13) | 0 of 2 | never |" in page
    draw_swings(found).savefig(tmp_path / "swings.png")
    draw_strip(found["mpc"]).savefig(tmp_path / "strip.png")


def test_a_method_nobody_knows_is_refused() -> None:
    with pytest.raises(
        ValueError, match=f"--method magic: unknown; there are {', '.join(METHODS)}"
    ):
        FluidControl(method=("magic",)).check()


def test_the_pictures_are_drawn(tmp_path: Path) -> None:
    assert len(draw_strip(FOUND["mpc"]).axes) == 12
    lines = draw_swings(FOUND).axes[0].get_lines()
    assert len(lines) == 2 * 2 + 2
    short = replace(FOUND["mpc"], momenta=FOUND["mpc"].momenta[:3])
    save_film(short, tmp_path / "film.gif")
    assert (tmp_path / "film.gif").stat().st_size > 1000


@pytest.mark.slow
def test_the_service_calms_a_wake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Real processes, the real solver, the bundled model."""
    monkeypatch.setattr(trials, "LEARN", 110)
    monkeypatch.setattr(trials, "DRIVE", 110)
    wanted = FluidControl(wakes=1, method=("mpc",), out=tmp_path, json=True)
    wanted.check()
    command.run(wanted)
    found = json.loads(capsys.readouterr().out.splitlines()[-1])["mpc"]
    assert found["swing_at_end"] < 0.1
    assert found["largest_rotation"] <= 0.42
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "control.md",
        "control.csv",
        "figure-16.png",
        "control-swings.png",
        "control-film.gif",
    }
