"""L1 by channel, and the share of pixels that err visibly."""

from __future__ import annotations

import numpy as np
import pytest

from koop_service.evaluation.fluid.errors import VISIBLE, compare, joined, stacked
from koop_service.evaluation.fluid.sequences import Units

UNITS = Units(
    ("rho", "rho u"), mean=0.2, scale=0.1, free_stream=0.25, window=(-2, 10, -3, 3), frame_time=0.8
)


def fields(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(5, 2, 6, 8)).astype(np.float16)


def test_the_mean_absolute_error_of_each_channel() -> None:
    pictures, truth = fields(0).astype(np.float32), fields(1)
    found = compare(pictures, truth, UNITS)
    apart = np.abs(pictures.astype(float) - truth.astype(float))
    np.testing.assert_allclose(found.absolute, apart.mean((2, 3)), rtol=1e-5)
    momentum = np.abs(UNITS.x_momentum(pictures) - UNITS.x_momentum(truth))
    np.testing.assert_allclose(found.visible, (momentum > VISIBLE).mean((1, 2)), atol=0.03)


def test_one_picture_for_all_frames() -> None:
    truth = fields(1)
    one, all_alike = (compare(p, truth, UNITS) for p in (fields(0)[:1], fields(0)[[0] * 5]))
    np.testing.assert_array_equal(one.absolute, all_alike.absolute)


@pytest.mark.parametrize(("share", "sign"), [(0.9, 1), (1.1, 1), (1.1, -1)])
def test_visible_is_an_error_above_the_threshold_in_x_momentum_alone(share, sign) -> None:
    truth = np.zeros((3, 2, 4, 4), np.float32)
    pictures = truth.copy()
    pictures[:, 0] += 100
    pictures[1, 1, :2] += sign * share * VISIBLE * UNITS.free_stream / UNITS.scale
    found = compare(pictures, truth, UNITS)
    np.testing.assert_array_equal(found.visible, [0, 0.5 if share > 1 else 0, 0])


def test_parts_are_put_together_along_the_frames() -> None:
    truth = fields(1)
    first, last = (compare(fields(0)[k], truth[k], UNITS) for k in (slice(0, 2), slice(2, 5)))
    whole = compare(fields(0), truth, UNITS)
    np.testing.assert_array_equal(joined([first, last], 0).absolute, whole.absolute)
    np.testing.assert_array_equal(joined([first, last], 0).visible, whole.visible)
    assert stacked([whole, whole]).absolute.shape == (2, 5, 2)
    np.testing.assert_array_equal(whole.on(lambda x: x[::2]).visible, whole.visible[::2])
