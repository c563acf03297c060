"""Theta_k from the factor against the paper's KKT system (eq. 7) and the dense formula."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.estimation.proximal import solve
from koop_service.estimation.settings import EstimatorSettings

from .oracles import conditioned, lifted_pendulum, rounded, singular, theta_dense, theta_kkt
from .strategies import Problem, folded, problems


def relative(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(rounded(found - wanted)) / np.linalg.norm(rounded(wanted)))


def solved(W: np.ndarray, Y: np.ndarray, rho: float, k: int) -> np.ndarray:
    sizes = EstimatorSettings(Y.shape[1], history=1, control_size=W.shape[1] - Y.shape[1], rho=rho)
    factor = folded(Problem(sizes, W, Y))
    return solve(factor.R, factor.D, rho, k)


@settings(max_examples=15, deadline=None)
@given(problems(most=15), st.integers(1, 4))
def test_the_solve_gives_the_papers_kth_iterate(problem: Problem, k: int) -> None:
    rho, factor = problem.settings.rho, folded(problem)
    wanted = rounded(theta_kkt(problem.W, problem.Y, rho, k))
    found = solve(factor.R, factor.D, rho, k)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-8 * (1 + np.max(np.abs(wanted))))


def test_the_two_oracles_agree_to_forty_digits() -> None:
    rng = np.random.default_rng(0)
    W, Y = rng.standard_normal((12, 5)), rng.standard_normal((12, 2))
    difference = theta_kkt(W, Y, 1e-6, 4) - theta_dense(W, Y, 1e-6, 4)
    assert np.max(np.abs(difference)) < 1e-40


@pytest.mark.parametrize(
    ("regressors", "bound"),
    [
        (conditioned(1.8), 2e-15),
        (conditioned(1e6), 2e-10),
        (conditioned(1e10), 5e-10),
        (singular, 2e-8),
    ],
)
def test_rounding_stays_that_of_a_square_root_method(regressors, bound: float) -> None:
    rng = np.random.default_rng(0)
    W = regressors(rng, 60, 16)
    Y = W @ rng.standard_normal((16, 8)) / 4 + 1e-3 * rng.standard_normal((60, 8))
    assert relative(solved(W, Y, 1e-8, 4), theta_dense(W, Y, 1e-8, 4)) < bound


def test_rounding_on_the_codes_of_a_pendulum() -> None:
    W, Y = lifted_pendulum(np.random.default_rng(0), 60, 8)
    assert relative(solved(W, Y, 1e-8, 4), theta_dense(W, Y, 1e-8, 4)) < 5e-13


def test_the_fixed_point_on_singular_data_is_the_minimum_norm_solution() -> None:
    rng = np.random.default_rng(1)
    W = singular(rng, 60, 9)
    Y = rng.standard_normal((60, 3))
    np.testing.assert_allclose(
        solved(W, Y, 1e-2, 12), (np.linalg.pinv(W, rcond=1e-12) @ Y).T, atol=1e-8
    )


@pytest.mark.parametrize(
    ("R", "D", "k", "complaint"),
    [
        (np.eye(3), np.zeros((2, 1)), 1, r"expected \(d, d\) and \(d, n\)"),
        (np.ones((3, 2)), np.zeros((3, 1)), 1, r"expected \(d, d\) and \(d, n\)"),
        (np.eye(3), np.zeros(3), 1, r"expected \(d, d\) and \(d, n\)"),
        (np.eye(3), np.zeros((3, 1)), 0, "1 or more"),
    ],
)
def test_bad_arguments_are_refused(R: np.ndarray, D: np.ndarray, k: int, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        solve(R, D, 1e-2, k)
