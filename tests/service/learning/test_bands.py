"""Bands on codes of a linear plant that an encoder shows with an error of its own."""

import dataclasses

import numpy as np
import pytest

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import EstimatorDefaults, ModelCard
from koop_service.estimation.estimator import Bank
from koop_service.learning.bands import LEVEL, band_scale, coverage, half_width, ratios
from koop_service.learning.judging import judged
from koop_service.learning.streaming import Encoded, moments
from koop_service.prediction.uncertainty import SCALE_HORIZONS

DEFAULTS = EstimatorDefaults(rho=1e-3)


def swings(count, seed, size=0.02):
    """Trajectories of two codes that rotate at a speed of their own, each code off by `size`."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        phase = rng.uniform(0.2, 0.4) * np.arange(160) + rng.uniform(0, 6)
        codes = np.stack([np.cos(phase), np.sin(phase)], axis=1)
        codes += rng.normal(size=codes.shape) * size
        found.append(Encoded(np.zeros(0), codes, np.zeros((159, 0))))
    return found


def test_gaussian_widths():
    assert half_width(0.9) == pytest.approx(1.6449, abs=1e-4)
    assert half_width(0.5) == pytest.approx(0.6745, abs=1e-4)


def test_errors_of_single_codes_make_raw_bands_too_wide_and_factors_mend_it():
    calibrated = dataclasses.replace(DEFAULTS, band_scale=band_scale(swings(40, 0), DEFAULTS))
    unseen = swings(40, 1)
    raw, mended = (ratios(unseen, defaults) for defaults in (DEFAULTS, calibrated))
    assert coverage(raw, LEVEL)[-1] > 0.98  # these errors do not add up over the steps
    np.testing.assert_allclose(coverage(mended, LEVEL), LEVEL, atol=0.05)
    np.testing.assert_allclose(coverage(mended, 0.5), 0.5, atol=0.08)


def test_factors_are_what_the_quantiles_say():
    data = swings(5, 2)
    scale = band_scale(data, DEFAULTS)
    found = ratios(data, dataclasses.replace(DEFAULTS, band_scale=scale))
    np.testing.assert_allclose(coverage(found, LEVEL), LEVEL, atol=0.01)
    assert band_scale(data, dataclasses.replace(DEFAULTS, band_scale=(9.0,) * 5)) == scale


def test_what_never_moves_says_nothing():
    still = [Encoded(np.zeros(0), np.zeros((100, 2)), np.zeros((99, 0)))]
    assert np.isnan(ratios(still, DEFAULTS)).all()
    assert band_scale(still, DEFAULTS) == ()
    assert not coverage(ratios(still, DEFAULTS), LEVEL).any()


def test_trajectories_too_short_to_judge():
    short = [Encoded(np.zeros(0), np.ones((15, 2)), np.zeros((14, 0)))]
    assert ratios(short, DEFAULTS).shape == (0, len(SCALE_HORIZONS), 2)
    assert band_scale(short, DEFAULTS) == ()


def test_moments_know_what_the_services_bank_knows():
    trajectory, settings = swings(1, 3)[0], DEFAULTS.settings(2, 0)
    bank = Bank(settings)
    lane, done = bank.open(), 1
    for moment in moments(trajectory, settings, 20):
        for t in range(done, moment.t):
            w = np.concatenate([trajectory.codes[t - 1 : t + 1].ravel(), [1.0]])
            bank.fold(np.array([lane]), w[None], trajectory.codes[None, t + 1])
        done = moment.t
        np.testing.assert_array_equal(moment.S, bank.covariance(lane))
        np.testing.assert_array_equal(moment.R, bank.factor(lane).R)
        np.testing.assert_array_equal(moment.model.A, bank.theta(lane)[:, :4])
    assert done == 130  # of 160 frames, with 20 to come: moments at 20, 30, ..., 130


def test_training_writes_the_factors_on_the_card(recording):
    codec = ImageCodec(initialised(8, 0), ModelCard("blobs", "test", 0.05))
    scale = judged(codec, recording, ()).estimator.band_scale
    assert len(scale) == len(SCALE_HORIZONS)
