"""`koop-eval fluid` as it is typed, on small waves in the place of simulated flows."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from koop_service.evaluation import cli
from koop_service.evaluation.datasets import kept_at
from koop_service.evaluation.fluid.cases import WAKES, cases

from .waves import write_model, write_set

COUNT, SEED = 3, 1000
FIGURES = {"figure-14.png", "held-out.png"}
MODELS = {wake.model for wake in WAKES.values()}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    for wake in WAKES.values():
        for case in cases(wake, COUNT, (60.0,)):
            write_set(kept_at(case.system, 1, SEED, folder), case, case.reynolds)
    return folder


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    folder = tmp_path / "weights"
    for name in MODELS:
        write_model(folder / f"{name}.safetensors")
    write_model(folder / "baselines/cylinder-actuated-learned-B.safetensors", "learned-B")
    return folder


@pytest.fixture
def evaluate(data: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Type the command; the folder of what it wrote."""

    def run(*more: str) -> Path:
        folders = ["--data", str(data), "--weights", str(weights), "--out", str(tmp_path / "out")]
        counts = ["--trajectories", str(COUNT), "--seed", str(SEED)]
        monkeypatch.setattr(sys, "argv", ["koop-eval", "fluid", *folders, *counts, *more])
        cli.main()
        return tmp_path / "out"

    return run


def test_end_to_end_with_a_model_missing(
    evaluate, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (weights / "cylinder.safetensors").unlink()
    out = evaluate("--held-out", "60", "--json")
    said = capsys.readouterr()
    table = json.loads(said.out.splitlines()[-1])
    assert list(table) == ["cylinder-actuated", "cylinder-chirp"]
    splits, chirp = table["cylinder-actuated"], table["cylinder-chirp"]
    assert list(splits) == ["overlapping", "apart", "reynolds-60"]
    assert list(chirp) == ["overlapping", "apart"]
    for methods in (*splits.values(), *chirp.values()):
        assert "learned-B-full" in methods
        for errors in methods.values():
            assert list(errors) == ["0.15", "1.5", "7.5", "15", "mean", "visible"]
            assert all(0 <= x < 10 for x in errors.values())
    strips = {f"figure-15-{name}.png" for name in table}
    files = FIGURES | strips | {"report.md", "table.csv"}
    assert {path.name for path in out.iterdir()} == files
    page = (out / "report.md").read_text()
    assert "`koop-eval fluid --trajectories 3 --seed 1000 --held-out 60`" in page
    assert str(weights) not in page
    assert "Strouhal" not in page  # a turning cylinder's wake has no period of its own
    skipped = "cylinder skipped: there is no cylinder.safetensors"
    assert skipped in said.err
    assert f"- {skipped}" in page
    assert "cylinder-actuated at Re 60: L1 after the fit offline " in said.err


def test_one_wake_at_one_reynolds_number(evaluate, capsys: pytest.CaptureFixture[str]) -> None:
    out = evaluate("--system", "cylinder", "--held-out", "--json")
    said = capsys.readouterr()
    table = json.loads(said.out.splitlines()[-1])
    assert list(table) == ["cylinder"]
    assert list(table["cylinder"]) == ["overlapping", "apart"]
    assert not (out / "figure-15-cylinder-actuated.png").exists()
    assert not (out / "held-out.png").exists()
    page = (out / "report.md").read_text()
    assert "--system cylinder --trajectories 3 --seed 1000 --held-out`" in page
    assert "held-out.png" not in page
    assert "cylinder goes without learned-A" in said.err
    assert "cylinder goes without learned-A" in page


def test_nothing_to_evaluate(evaluate, weights: Path) -> None:
    for name in MODELS:
        (weights / f"{name}.safetensors").unlink()
    with pytest.raises(SystemExit, match=r"nothing to evaluate: .* holds no model of the flow"):
        evaluate()


def test_wrong_options(evaluate) -> None:
    for wrong, words in (
        (("--system", "sphere"), "unknown system 'sphere'"),
        (("--trajectories", "0"), "--trajectories is 0; expected 1 or more"),
        (("--seed", "12"), "test seeds start at 1000"),
        (("--held-out", "50"), "--held-out 50 is the Reynolds number that was trained on"),
    ):
        with pytest.raises(SystemExit, match=words):
            evaluate(*wrong)
