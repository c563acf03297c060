"""The metric is the paper's, by its naive definition."""

import math

import numpy as np
import pytest

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard
from koop_service.evaluation.metrics import (
    decoded_errors,
    frame_at,
    rmse_over_time,
    score,
    spread_over_time,
    squared_errors,
)


def test_rmse_is_over_trajectories_and_pixels():
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (3, 2, 4, 4), dtype=np.uint8)
    pictures = rng.random((3, 2, 4, 4)).astype(np.float32)
    errors = squared_errors(pictures, frames)
    assert errors.shape == (3, 2)
    for t in range(2):
        apart = [
            (float(pictures[n, t, i, j]) - frames[n, t, i, j] / 255) ** 2
            for n in range(3)
            for i in range(4)
            for j in range(4)
        ]
        assert rmse_over_time(errors)[t] == pytest.approx(math.sqrt(sum(apart) / len(apart)))


def test_score_and_spread():
    errors = np.array([[0.0, 0.01], [0.0, 0.04], [0.0, 0.09]])
    found = score(errors, 1)
    assert found.rmse == pytest.approx(math.sqrt(0.14 / 3))
    assert (found.p10, found.p50, found.p90) == pytest.approx((0.12, 0.2, 0.28))
    np.testing.assert_allclose(spread_over_time(errors)[:, 1], [0.12, 0.2, 0.28])


def test_horizons_count_from_the_last_frame_of_the_fit():
    assert [frame_at(h, 80, 0.05) for h in (0.05, 1.0, 15.0)] == [80, 99, 379]


def test_codes_that_exploded_decode_to_finite_pictures():
    codec = ImageCodec(initialised(8, 0), ModelCard("pendulum", "test", 0.05))
    codes = np.array([1e6, -1e6, 0.0])[None, :, None] * np.ones((1, 3, 8))
    errors = decoded_errors(codec, codes, np.zeros((1, 3, 64, 64), np.uint8))
    assert errors.shape == (1, 3)
    assert ((errors >= 0) & (errors <= 1)).all()
