"""The sliding window: what left the factor is as if it had never been there."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.estimation import window as sliding
from koop_service.estimation.rotations import rotate_out
from koop_service.estimation.settings import EstimatorSettings

from .strategies import Problem, folded, information, problems


def last(problem: Problem, N: int) -> Problem:
    return Problem(replace(problem.settings, window=None), problem.W[-N:], problem.Y[-N:])


@settings(max_examples=60, deadline=None)
@given(problem=problems(most=60), N=st.integers(1, 30))
def test_the_window_equals_a_refit_on_its_measurements(problem: Problem, N: int) -> None:
    windowed = Problem(replace(problem.settings, window=N), problem.W, problem.Y)
    refit = last(problem, N)
    for one, other in zip(information(folded(windowed)), information(folded(refit)), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-10)


@pytest.mark.parametrize("forgetting", [0.7, 0.9, 0.98])
@pytest.mark.parametrize("N", [5, 25])
def test_downdating_and_rebuilding_agree_under_forgetting(forgetting: float, N: int) -> None:
    rng = np.random.default_rng(0)
    sizes = EstimatorSettings(3, 2, 1, forgetting=forgetting, window=N)
    problem = Problem(sizes, rng.standard_normal((90, 7)), rng.standard_normal((90, 3)))
    for K in (N + 1, 40, 83, 90):
        factor = folded(Problem(sizes, problem.W[:K], problem.Y[:K]))
        rebuilt = factor.rows.copy()
        stride, x = sizes.refill_stride, np.zeros(10)
        # Just refilled rows are whole again, which `rebuild` is only ever asked before: step back.
        sliding.rebuild(rebuilt, factor.centre, factor.ring, x, K, sizes.rho, forgetting, stride)
        R, D = rebuilt[:7, :7], rebuilt[:7, 7:]
        due = (K // stride - 1) % 7 if K % stride == 0 else None
        M, C = information(factor)
        keep = [i for i in range(7) if i != due]
        np.testing.assert_allclose((R.T @ R)[keep], M[keep], rtol=0, atol=1e-11)
        np.testing.assert_allclose((R.T @ D)[keep], C[keep], rtol=0, atol=1e-11)


def test_a_row_of_age_n_leaves_with_the_weight_it_then_has() -> None:
    rng = np.random.default_rng(0)
    sizes = EstimatorSettings(2, 1, 1, forgetting=0.9, window=6, rho=1e-6)
    W, Y = rng.standard_normal((40, 3)), rng.standard_normal((40, 2))
    weights = 0.9 ** np.arange(5, -1, -1)
    M, _ = information(folded(Problem(sizes, W, Y)))
    np.testing.assert_allclose(M, (W[-6:].T * weights) @ W[-6:], rtol=0, atol=3e-6)


def test_a_downdate_that_would_not_be_positive_definite_says_so() -> None:
    rows = np.zeros((4, 4))
    rows[:2, :2] = np.eye(2)
    assert rotate_out(rows.copy(), np.array([0.5, 0.5, 0.0, 0.0]), 2)
    assert not rotate_out(rows.copy(), np.array([1.0, 0.0, 0.0, 0.0]), 2)
    assert not rotate_out(rows.copy(), np.array([0.0, 3.0, 0.0, 0.0]), 2)


@pytest.mark.parametrize("outlier", [1e3, 1e5, 1e9])
def test_a_failed_downdate_is_healed_by_an_exact_refactorisation(outlier: float) -> None:
    """A measurement far above the rest takes their digits with it, should it leave by downdate."""
    rng = np.random.default_rng(0)
    sizes = EstimatorSettings(2, 2, 0, window=10, rho=1e-6)
    W, Y = rng.standard_normal((40, 4)), rng.standard_normal((40, 2))
    W[15] *= outlier
    problem = Problem(sizes, W, Y)
    for one, other in zip(
        information(folded(problem)), information(folded(last(problem, 10))), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-8)


def test_many_windows_do_not_drift() -> None:
    rng = np.random.default_rng(0)
    sizes = EstimatorSettings(3, 2, 1, window=20, rho=1e-8)
    problem = Problem(sizes, rng.standard_normal((20_000, 7)), rng.standard_normal((20_000, 3)))
    for one, other in zip(
        information(folded(problem)), information(folded(last(problem, 20))), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11)
