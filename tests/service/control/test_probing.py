"""Probing inputs: rich, within the bounds and the rates, the same for the same seed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.control.probing import multisine

BOUNDS = st.tuples(st.floats(-100, 100), st.floats(0.01, 50)).map(lambda b: (b[0], b[0] + b[1]))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 99), st.integers(1, 80), st.integers(1, 3), BOUNDS, st.floats(0.001, 10.0))
def test_it_stays_within_bounds_and_rates(seed, steps, p, bounds, rate):
    low, high = bounds
    u = multisine(steps, p, low, high, -rate, 2 * rate, seed=seed)
    middle, slack = 0.5 * (low + high), 1e-9 * (1 + abs(low) + abs(high))
    assert u.shape == (steps, p)
    assert (np.abs(u - middle) <= 0.25 * (high - low) + slack).all()
    moves = np.diff(u, axis=0, prepend=middle)
    assert (np.abs(moves) <= rate + slack).all()


def test_channels_are_rich_and_do_not_look_like_each_other():
    u = multisine(120, 2, [-1.0, 0.0], [1.0, 10.0])
    u = u - u.mean(axis=0)
    correlation = np.corrcoef(u.T)[0, 1]
    assert abs(correlation) < 1e-9
    lagged = np.stack([u[i : i + 100] for i in range(4)], axis=2).reshape(100, -1)
    singular = np.linalg.svd(lagged / lagged.std(axis=0), compute_uv=False)
    assert singular[-1] > 0.02 * singular[0]
    used = np.abs(np.fft.rfft(u, axis=0)) > 1e-6
    np.testing.assert_array_equal(used.sum(axis=0), [15, 15])
    assert not (used[:, 0] & used[:, 1]).any()
    assert u[:, 0].std() > 0.1
    assert u[:, 1].std() > 0.5


def test_open_bounds_give_a_unit_amplitude_near_zero():
    u = multisine(60, 3, [-np.inf, 0.0, -np.inf], [np.inf, np.inf, -4.0], share=1.0)
    np.testing.assert_allclose(u.max(axis=0) - u.min(axis=0), [2.0, 2.0, 2.0], atol=0.7)
    assert (u[:, 1] >= 0.0).all()
    assert (u[:, 2] <= -4.0).all()


def test_the_seed_decides():
    np.testing.assert_array_equal(multisine(40, 2, seed=3), multisine(40, 2, seed=3))
    assert not np.allclose(multisine(40, 2, seed=3), multisine(40, 2, seed=4))


def test_a_rate_of_zero_leaves_nothing_to_probe_with():
    np.testing.assert_array_equal(multisine(10, 1, -1, 3, 0.0, 0.0), np.ones((10, 1)))


@pytest.mark.parametrize("arguments", [{"steps": 0}, {"share": 0.0}, {"share": 2.0}])
def test_bad_arguments_say_what_was_wrong(arguments):
    with pytest.raises(ValueError, match="expected 1 or more"):
        multisine(**({"steps": 10, "control_size": 1} | arguments))
