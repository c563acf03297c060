"""Frames are spoiled as they should be, and rho follows the residual."""

import dataclasses

import numpy as np
import pytest

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard
from koop_service.evaluation.fits import Proximal, TruncatedSVD
from koop_service.evaluation.studies import noise
from koop_service.evaluation.studies.noise import (
    DECADES,
    DISTURBANCES,
    Setting,
    errors,
    methods,
    noisy,
    occluded,
    outcome,
    rho_by_rule,
)

from ..linear_world import SETTINGS, linear_codes  # noqa: TID252


def test_sensor_noise():
    grey = np.full((2, 5, 64, 64), 128, np.uint8)
    spoiled = noisy(grey, 0.1, np.random.default_rng(0))
    assert spoiled.dtype == np.uint8
    assert (spoiled.astype(float) - 128).std() == pytest.approx(25.5, rel=0.02)
    black = noisy(0 * grey, 0.1, np.random.default_rng(0))
    assert black.min() == 0  # the sensor saturates, and does not wrap
    assert black.max() < 200
    np.testing.assert_array_equal(noisy(grey, 0.0, np.random.default_rng(0)), grey)


def test_occlusion_is_a_square_that_moves():
    white = np.full((2, 30, 64, 64), 255, np.uint8)
    spoiled = occluded(white, 12, np.random.default_rng(0))
    assert ((spoiled == 0).sum((-2, -1)) == 144).all()
    corners = {tuple(np.argwhere(frame == 0)[0]) for frame in spoiled.reshape(-1, 64, 64)}
    assert len(corners) > 50
    assert white.all()
    np.testing.assert_array_equal(occluded(white, 0, np.random.default_rng(0)), white)


@pytest.mark.parametrize("size", [1e-3, 1e-1])
def test_the_rule_gives_the_residuals_variance(size):
    codes, controls, _ = linear_codes(3, 200)
    rng = np.random.default_rng(0)
    # Noise of the plant, not of the codes: what is predicted is off by as much.
    for t in range(2, 200):
        codes[:, t] += size * rng.normal(size=(3, 2))
    rule = rho_by_rule(codes, controls, SETTINGS)
    # Each code's own noise and that of the two in its regressor add up: more than once, under
    # three times.
    assert size**2 < rule < 3 * size**2


def test_the_rule_stays_a_number_where_the_fit_is_exact():
    codes, controls, _ = linear_codes(3, 40)
    assert 1e-12 <= rho_by_rule(codes, controls, SETTINGS) < 1e-10


def test_methods_forget_nothing_within_one_fit():
    settings = dataclasses.replace(SETTINGS, forgetting=0.95, rho=0.5)
    found = methods(settings, 0.25)
    assert all(model.settings.forgetting == 1.0 for model in found.values())
    ours = {name: m.settings.rho for name, m in found.items() if isinstance(m, Proximal)}
    assert (ours["rho card"], ours["rho rule"], ours["rho 0.01"]) == (0.5, 0.25, 0.01)
    assert sum(isinstance(model, TruncatedSVD) for model in found.values()) == len(DECADES)


def test_errors_are_against_the_clean_frame(monkeypatch):
    monkeypatch.setattr(noise, "HORIZON", 0.1)  # two frames
    codec = ImageCodec(initialised(8, 0), ModelCard("x", "test", 0.05))
    rng = np.random.default_rng(0)
    clean = rng.integers(0, 255, (2, 52, 64, 64), dtype=np.uint8)
    seen = np.zeros_like(clean)
    found = errors(codec, clean, seen, np.zeros((2, 51, 0)), Setting("short", 40))
    shown = codec.decode(codec.encode(seen[:, -1])) - clean[:, -1] / 255
    assert found["autoencoder alone"] == pytest.approx(np.sqrt((shown**2).mean()), rel=1e-4)
    # All frames alike are predicted to stay so.
    assert found["rho card"] == pytest.approx(found["autoencoder alone"], rel=1e-3)


def made_up():
    found = {}
    for d in DISTURBANCES:
        for s in noise.SETTINGS:
            count = len(d.levels)
            curves = {f"svd {x:g}": np.full(count, 0.1) for x in DECADES}
            curves |= {f"rho {x:g}": np.full(count, 0.05) for x in DECADES}
            curves |= {"rho card": np.full(count, 0.06), "rho rule": np.full(count, 0.05)}
            curves["svd 0.1"] = np.full(count, 0.4)
            curves["autoencoder alone"] = np.full(count, 0.02)
            found[d.name, s.name] = curves
    return found


def test_words_and_rows():
    result = outcome(made_up(), 7)
    row = f"| noise | {noise.SETTINGS[0].name} | 4.0 | 1e-06 | 1.0 | 1.20 | 1.00 |"
    assert row in result.text
    assert "7 trajectories" in result.text
    assert "by up to 3.0 times" in result.text
    assert result.table["occlusion"][noise.SETTINGS[0].name]["rho card"]["20"] == 0.06
    methods_tried = 2 * len(DECADES) + 3
    levels = sum(len(d.levels) for d in DISTURBANCES)
    assert len(result.rows) == levels * len(noise.SETTINGS) * methods_tried
