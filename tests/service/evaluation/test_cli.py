"""koop-eval end to end on a small test set, and what it says when something does not fit."""

import json
import sys

import numpy as np
import pytest
import torch

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.weights import save_weights
from koop_service.evaluation import cli, datasets, systems, trained
from koop_service.evaluation.assessment import assess
from koop_service.evaluation.datasets import options
from koop_service.evaluation.systems import SYSTEMS

from .conftest import SEED, TRAJECTORIES, card

METHODS = [
    *("reconstruction", "offline", "partial", "full", "svd", "learned-A"),
    *("repeat-last", "mean-frame"),
]


@pytest.fixture
def evaluate(tmp_path, data, small_set, small_system, monkeypatch):  # noqa: ARG001
    """Run the command line as it is typed, on the small test set."""

    def run(weights, *more):
        folders = ["--data", str(data), "--weights", str(weights), "--out", str(tmp_path / "out")]
        counts = ["--trajectories", str(TRAJECTORIES), "--seed", str(SEED)]
        monkeypatch.setattr(sys, "argv", ["koop-eval", "prediction", *counts, *folders, *more])
        cli.main()
        return tmp_path / "out"

    return run


def test_end_to_end(evaluate, weights_with_baseline, capsys):
    out = evaluate(weights_with_baseline, "--json")
    said = capsys.readouterr()
    table = json.loads(said.out.splitlines()[-1])
    assert list(table) == ["pendulum-low"]
    assert list(table["pendulum-low"]) == METHODS
    assert all(list(errors) == ["0.05", "1"] for errors in table["pendulum-low"].values())
    assert all(0 < e < 1 for errors in table["pendulum-low"].values() for e in errors.values())
    assert {p.name for p in out.iterdir()} >= {"report.md", "table.csv", "figure-07.png"}
    assert "![Figure 9](figure-09.png)" in (out / "report.md").read_text()
    assert "cartpole skipped: there is no cartpole.safetensors" in said.err
    assert str(weights_with_baseline) not in (out / "report.md").read_text()


def test_a_missing_baseline_is_said_and_skipped(evaluate, weights, capsys):
    out = evaluate(weights, "--system", "pendulum-low")
    said = capsys.readouterr().err
    assert "pendulum-low goes without learned-A: there is no baselines/pendulum-low-learned" in said
    assert "figure 9 lacks learned-A of pendulum-low" in said
    assert "cartpole" not in said
    assert not (out / "figure-09.png").exists()


def test_the_methods_are_what_they_are_called(small_set, small_system, weights_with_baseline):
    models, _ = trained.load(weights_with_baseline, small_system)
    result = assess(small_system, models, small_set)
    frames, m = small_set.recording.frames / 255, small_system.fit_frames
    for n in range(TRAJECTORIES):
        still = np.square(frames[n, m:] - frames[n, m - 1]).mean((1, 2))
        np.testing.assert_allclose(result.errors["repeat-last"][n, m:], still, rtol=1e-4)
        mean = np.square(frames[n, m:] - frames[:, :m].mean((0, 1))).mean((1, 2))
        np.testing.assert_allclose(result.errors["mean-frame"][n, m:], mean, rtol=1e-4)
    codec = models.codec
    own = np.square(codec.decode(codec.encode(small_set.recording.frames[0])) - frames[0])
    for method in ("reconstruction", "offline", "full", "repeat-last", "learned-A"):
        np.testing.assert_allclose(result.errors[method][0, :m], own[:m].mean((1, 2)), rtol=1e-3)
    # This learned A repeats the last code.
    last = codec.decode(codec.encode(small_set.recording.frames[0, m - 1 : m]))
    frozen = np.square(last - frames[0, m:]).mean((1, 2))
    np.testing.assert_allclose(result.errors["learned-A"][0, m:], frozen, rtol=1e-3)
    assert set(result.strip) >= {"truth", "offline", "partial", "full", "learned-A"}
    assert result.frame_at(10.0) is None
    assert not result.angles


def refused(evaluate, folder, capsys, *more):
    with pytest.raises(SystemExit) as stopped:
        evaluate(folder, *more)
    return str(stopped.value) + capsys.readouterr().err


def test_nothing_to_evaluate(evaluate, tmp_path, capsys):
    assert "nothing to evaluate" in refused(evaluate, tmp_path, capsys)


def test_wrong_options(evaluate, weights, capsys):
    said = refused(evaluate, weights, capsys, "--system", "unicycle")
    assert "unknown system 'unicycle'; there are all, pendulum-low" in said
    said = refused(evaluate, weights, capsys, "--seed", "3")
    assert "test seeds start at 1000" in said
    said = refused(evaluate, weights, capsys, "--trajectories", "0")
    assert "expected 1 or more" in said


def test_one_thread_unless_told_otherwise(evaluate, weights, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(torch, "set_num_threads", asked.append)
    evaluate(weights)
    evaluate(weights, "--threads", "3")
    assert asked == [1, 3]
    assert "--threads is 0; expected 1 or more" in refused(
        evaluate, weights, capsys, "--threads", "0"
    )


@pytest.mark.parametrize("name", cli.SUBCOMMANDS)
def test_every_subcommand_says_what_it_takes(monkeypatch, capsys, name):
    monkeypatch.setattr(sys, "argv", ["koop-eval", name, "--help"])
    with pytest.raises(SystemExit, match="0"):
        cli.main()
    said = capsys.readouterr().out
    assert all(option in said for option in ("--out", "--weights", "--threads", "--json"))


def test_weights_of_another_renderer(evaluate, weights, capsys):
    save_weights(weights / "pendulum-low.safetensors", initialised(8, 0), card("panda"))
    said = refused(evaluate, weights, capsys)
    assert "trained on frames by 'panda'" in said
    assert "train them anew" in said


def test_a_baseline_that_learned_nothing(evaluate, weights, capsys):
    path = weights / "baselines" / "pendulum-low-learned-A.safetensors"
    save_weights(path, initialised(8, 0), card())
    assert "holds no learned dynamics; expected learned-A" in refused(evaluate, weights, capsys)


def test_koop_dataset_is_not_installed(monkeypatch, tmp_path, small_system):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ValueError, match=r"not installed: pip install 'koop\[train\]'"):
        datasets.test_set(small_system, 1, 1000, tmp_path)


def test_koop_dataset_fails(monkeypatch, tmp_path, small_system):
    command = tmp_path / "koop-dataset"
    command.write_text("#!/bin/sh\nexit 3\n")
    command.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    with pytest.raises(ValueError, match="failed with exit code 3"):
        datasets.test_set(small_system, 1, 1000, tmp_path)


def test_a_test_set_is_made_once(data, small_set, small_system, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    again = datasets.test_set(small_system, TRAJECTORIES, SEED, data)
    np.testing.assert_array_equal(again.recording.frames, small_set.recording.frames)
    assert again.states.shape == (TRAJECTORIES, 70, 2)


def test_the_options_of_a_test_set():
    typed = " ".join(options(SYSTEMS["cartpole-actuated"], 100, 1000))
    assert typed == (
        "--system cartpole --actuated --excitation paper"
        " --trajectories 100 --frames 400 --seed 1000"
    )


def test_choosing_systems():
    assert [s.name for s in systems.chosen(("cartpole", "pendulum-low"))] == [
        "pendulum-low",
        "cartpole",
    ]
    assert systems.chosen(()) == systems.chosen(("all",)) == [*SYSTEMS.values()]
