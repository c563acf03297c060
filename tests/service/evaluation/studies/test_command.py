"""`koop-eval studies` as it is typed."""

import json
import sys

import pytest

from koop_service.evaluation import cli, systems

COUNTS = ["--trajectories", "2", "--seed", "1000"]


@pytest.fixture
def study(tmp_path, data, small_set, small_system, monkeypatch):  # noqa: ARG001
    """Run the command line on the small test set; only pendulum-low is in the table."""
    for name in [n for n in systems.SYSTEMS if n != "pendulum-low"]:
        monkeypatch.delitem(systems.SYSTEMS, name)

    def run(weights, *more):
        folders = ["--data", str(data), "--weights", str(weights), "--out", str(tmp_path / "out")]
        monkeypatch.setattr(sys, "argv", ["koop-eval", "studies", *COUNTS, *folders, *more])
        cli.main()
        return tmp_path / "out"

    return run


def test_end_to_end(study, weights, capsys):
    out = study(weights, "--study", "calibration", "--json")
    said = capsys.readouterr()
    table = json.loads(said.out.splitlines()[-1])
    assert list(table) == ["calibration"]
    assert list(table["calibration"]["pendulum-low"]) == ["50%", "90%"]
    assert {p.name for p in out.iterdir()} == {
        *(f"study-calibration.{end}" for end in ("png", "csv", "md")),
        "report.md",
    }
    assert "Calibrated uncertainty" in (out / "report.md").read_text()
    assert "pendulum-low: its card has no factors" in said.err


def test_the_report_of_predictions_keeps_its_own(study, weights):
    (weights.parent / "out").mkdir()
    page = weights.parent / "out" / "report.md"
    page.write_text("# Prediction: our numbers\n\nKept.\n")
    study(weights, "--study", "calibration")
    assert "Kept." in page.read_text()
    assert "# Beyond the paper" in page.read_text()


def test_nothing_to_study(study, tmp_path, capsys):
    with pytest.raises(SystemExit, match="nothing to study"):
        study(tmp_path, "--study", "calibration")
    assert "there is no pendulum-low.safetensors" in capsys.readouterr().err


def test_wrong_options(study, weights):
    with pytest.raises(SystemExit, match="expected 1 or more"):
        study(weights, "--trajectories", "0")
    with pytest.raises(SystemExit):
        study(weights, "--study", "everything")
