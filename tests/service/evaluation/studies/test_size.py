"""The rule for n_z, and the rank that needs no training."""

import numpy as np
import pytest

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard, save_weights
from koop_service.evaluation.studies import size
from koop_service.evaluation.studies.bench import Bench
from koop_service.evaluation.studies.size import Score, outcome, recommended, spectrum


def test_the_smallest_that_is_nearly_the_best():
    assert recommended({2: 0.5, 4: 0.109, 8: 0.1, 12: 0.12}) == 4
    assert recommended({2: 0.5, 4: 0.111, 8: 0.1, 12: 0.12}) == 8
    assert recommended({12: 0.1}) == 12


def codec(n):
    return ImageCodec(initialised(n, 0), ModelCard("x", "test", 0.05, code_size=n))


@pytest.mark.parametrize("modes", [1, 2, 3])
def test_rank_counts_the_modes_of_the_codes(modes):
    rng = np.random.default_rng(0)
    frequencies = np.array([0.3, 0.71, 1.3])[:modes]
    phases = frequencies[:, None] * np.arange(150) + rng.uniform(0, 6, (4, modes, 1))
    swings = np.concatenate([np.cos(phases), np.sin(phases)], axis=1).swapaxes(1, 2)
    codes = swings @ rng.normal(size=(2 * modes, 8)) + 1e-4 * rng.normal(size=(4, 150, 8))
    found = spectrum(codes, np.zeros((4, 149, 0)), codec(8), "x")
    assert (found.ranks == 2 * modes).all()  # a swing is a cosine and a sine, however many codes
    assert found.code_size == modes


def scores(*errors):
    return {n: Score(e / 2, {1.0: e, 5.0: 2 * e}) for n, e in zip((2, 4, 8), errors, strict=True)}


def test_words_and_rows():
    found = size.Spectrum(np.ones((3, 16)) * np.arange(16, 0, -1), np.full(3, 5.5), 2, "big")
    result = outcome(scores(0.5, 0.1, 0.1), found, 9)
    assert result.table["recommended"] == 4
    assert result.table["sizes"]["8"] == {"reconstruction": 0.05, "1": 0.1, "5": 0.2}
    assert result.table["rank"] == {"median": 11.0, "recommended": 6}
    assert "**n_z = 4**" in result.text
    assert "| 2 | 0.2500 | 0.5000 | 1.0000 |" in result.text
    alone = outcome({}, found, 9)
    assert alone.table["recommended"] is None
    assert "No models of several sizes" in alone.text
    assert "asks for n_z = 6" in alone.text


@pytest.fixture
def bench(tmp_path, data, small_set, small_system, monkeypatch):  # noqa: ARG001
    """A folder of weights with a model for pendulum-low, and what is said of it."""
    monkeypatch.setattr(size, "HORIZONS", (0.5, 1.0))
    (tmp_path / "sizes").mkdir()
    keep(tmp_path / "pendulum-low.safetensors", 8)
    said: list[str] = []
    return Bench(tmp_path, data, len(small_set.states), 1000, said.append), said


def keep(path, n):
    save_weights(path, initialised(n, 0), ModelCard("x", "koop-sdf-1", 0.05, code_size=n))


def test_every_size_that_there_is(bench):
    for n in (12, 4):
        keep(bench[0].weights / "sizes" / f"pendulum-low-nz{n}.safetensors", n)
    result = size.study(bench[0])
    assert list(result.table["sizes"]) == ["4", "12"]
    assert "history matrix of pendulum-low-nz12 has rank" in result.text
    assert any(line.startswith("recommended n_z: ") for line in bench[1])


def test_without_sizes_the_rank_is_shown(bench):
    result = size.study(bench[0])
    assert result.table["recommended"] is None
    assert "history matrix of pendulum-low has rank" in result.text
    assert any("there are no sizes/pendulum-low-nz*.safetensors" in line for line in bench[1])


def test_without_any_model(bench):
    (bench[0].weights / "pendulum-low.safetensors").unlink()
    assert size.study(bench[0]) is None
