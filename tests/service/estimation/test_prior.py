"""A prior that is centred on a known Theta: the same as fitting what that Theta leaves."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.estimation.estimator import Bank
from koop_service.estimation.proximal import solve
from koop_service.estimation.settings import EstimatorSettings, Rows

from .oracles import rounded, theta_dense
from .strategies import Problem, folded, problems


def rows_of(Theta: np.ndarray) -> Rows:
    return tuple(tuple(row) for row in Theta.tolist())


def around(sizes: EstimatorSettings, seed: int) -> tuple[EstimatorSettings, np.ndarray]:
    """The settings with a random prior's mean, and that mean (n, d)."""
    mean = np.random.default_rng(seed).standard_normal((sizes.code_size, sizes.regressor_size))
    return replace(sizes, prior_mean=rows_of(mean)), mean


def theta(problem: Problem) -> np.ndarray:
    """As the service solves it, from a lane of a bank."""
    bank = Bank(problem.settings)
    lane = bank.open()
    bank.fold(np.full(len(problem.W), lane), problem.W, problem.Y)
    return bank.theta(lane)


@settings(max_examples=60, deadline=None)
@given(
    problem=problems(most=60),
    forgetting=st.sampled_from([0.8, 0.97, 1.0]),
    window=st.sampled_from([None, 7]),
    refinements=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_it_is_the_fit_of_what_the_mean_leaves(
    problem: Problem, forgetting: float, window: int | None, refinements: int, seed: int
) -> None:
    plain = replace(problem.settings, forgetting=forgetting, window=window, refinements=refinements)
    centred, mean = around(plain, seed)
    left = problem.Y - problem.W @ mean.T
    found = theta(Problem(centred, problem.W, problem.Y))
    wanted = mean + theta(Problem(plain, problem.W, left))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7 * (1 + np.abs(wanted).max()))


@settings(max_examples=15, deadline=None)
@given(problems(most=15), st.integers(1, 3))
def test_it_is_the_papers_iteration_from_the_mean(problem: Problem, k: int) -> None:
    centred, mean = around(replace(problem.settings, refinements=k), seed=1)
    factor = folded(Problem(centred, problem.W, problem.Y))
    found = solve(factor.R, factor.D, centred.rho, k, centred.centre)
    left = problem.Y - problem.W @ mean.T
    wanted = mean + rounded(theta_dense(problem.W, left, centred.rho, k))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-8 * (1 + np.abs(wanted).max()))


def test_before_any_measurement_the_model_is_the_mean() -> None:
    centred, mean = around(EstimatorSettings(3, 2, 1, affine=True, forgetting=0.9), seed=2)
    bank = Bank(centred)
    lane = bank.open()
    np.testing.assert_allclose(bank.theta(lane), mean, rtol=1e-15)
    bank.fold(np.full(40, lane), np.ones((40, 8)), np.ones((40, 3)))
    assert not np.allclose(bank.theta(lane), mean)
    bank.reset(lane)
    np.testing.assert_allclose(bank.theta(lane), mean, rtol=1e-15)


def test_a_prior_that_knows_nothing_is_told_from_one_that_does() -> None:
    plain = EstimatorSettings(3, 2, 1, rho=0.3)
    assert plain.ignorance == 0.3
    assert around(plain, seed=0)[0].ignorance == 0


@pytest.mark.parametrize(
    ("mean", "complaint"),
    [
        (np.zeros((2, 7)), "3 rows of 7"),
        (np.zeros((3, 6)), "3 rows of 7"),
        (np.full((3, 7), np.nan), "finite"),
    ],
)
def test_a_mean_that_does_not_fit_is_refused(mean: np.ndarray, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        EstimatorSettings(3, 2, 1, prior_mean=rows_of(mean))
