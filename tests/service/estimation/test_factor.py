"""The single-stream factor against the dense definition in 50 digits, and at rest."""

import numpy as np
import pytest
from hypothesis import given, settings

from koop_service.estimation import factor as single
from koop_service.estimation.settings import EstimatorSettings

from .oracles import dense_stream, exact, rounded
from .rest import at_rest, rest_then_move
from .strategies import Problem, folded, information, problems

SIZES = EstimatorSettings(code_size=8, history=2, control_size=1)


def distance(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference, relative to the largest number wanted."""
    return float(np.max(np.abs(rounded(exact(found) - wanted)))) / float(np.max(np.abs(wanted)))


@settings(max_examples=40, deadline=None)
@given(problems())
def test_the_factor_is_that_of_batch_ridge_regression(problem: Problem) -> None:
    W, Y, rho = exact(problem.W), exact(problem.Y), problem.settings.rho
    M, C = information(folded(problem))
    d, n = problem.settings.regressor_size, problem.settings.code_size
    assert distance(M, W.T @ W + exact(rho * np.eye(d))) < 1e-14
    assert np.max(np.abs(C - rounded(W.T @ Y)), initial=0.0) < 1e-13 * (1 + len(W))
    assert C.shape == (d, n)


@settings(max_examples=40, deadline=None)
@given(problems())
def test_the_factor_stays_triangular_with_a_positive_diagonal(problem: Problem) -> None:
    R = folded(problem).R
    assert np.array_equal(R, np.triu(R))
    assert np.all(np.diag(R) > 0.0)
    smallest = np.linalg.eigvalsh(R.T @ R)[0]
    assert smallest > problem.settings.rho * (1 - 1e-6) - 1e-13


@settings(max_examples=40, deadline=None)
@given(problems())
def test_without_forgetting_the_order_does_not_matter(problem: Problem) -> None:
    backwards = Problem(problem.settings, problem.W[::-1].copy(), problem.Y[::-1].copy())
    for one, other in zip(
        information(folded(problem)), information(folded(backwards)), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13 * (1 + len(problem.W)))


@pytest.mark.parametrize("forgetting", [0.6, 0.9, 0.99])
@settings(max_examples=10, deadline=None)
@given(problem=problems(most=60))
def test_forgetting_weighs_exponentially_and_refills_the_prior(
    problem: Problem, forgetting: float
) -> None:
    sizes = EstimatorSettings(
        problem.settings.code_size,
        problem.settings.history,
        problem.settings.control_size,
        rho=problem.settings.rho,
        affine=problem.settings.affine,
        forgetting=forgetting,
    )
    d, n, stride = sizes.regressor_size, sizes.code_size, sizes.refill_stride
    oracle = dense_stream(d, n, sizes.rho, forgetting, stride)
    for w, y in zip(problem.W, problem.Y, strict=True):
        oracle.fold(w, y)
    M, C = information(folded(Problem(sizes, problem.W, problem.Y)))
    assert distance(M, oracle.M) < 1e-13
    assert float(np.max(np.abs(rounded(exact(C) - oracle.C)))) < 1e-9


def test_the_innovation_is_the_prediction_error_normalised_by_its_leverage() -> None:
    rng = np.random.default_rng(1)
    problem = Problem(SIZES, rng.standard_normal((50, 17)), rng.standard_normal((50, 8)))
    factor = folded(problem)
    w, y = rng.standard_normal(17), rng.standard_normal(8)
    M, C = information(factor)
    doubt = w @ np.linalg.solve(M, w)
    error = y - np.linalg.solve(M, C).T @ w
    e = single.update(factor, SIZES, w, y)
    np.testing.assert_allclose(e, error / np.sqrt(1 + doubt), rtol=1e-10)


def test_fifty_thousand_updates_do_not_drift() -> None:
    rng = np.random.default_rng(2)
    w, y = rng.integers(-8, 9, (100, 17)) / 8.0, rng.integers(-8, 9, (100, 8)) / 8.0
    factor = folded(Problem(SIZES, np.tile(w, (500, 1)), np.tile(y, (500, 1))))
    M, C = information(factor)
    assert distance(M, exact(500 * (w.T @ w) + SIZES.rho * np.eye(17))) < 1e-12
    assert distance(C, exact(500 * (w.T @ y))) < 1e-12


@pytest.mark.parametrize("forgetting", [0.9, 0.99])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_after_a_long_rest_motion_is_learned_in_40_frames(forgetting: float, level: float) -> None:
    z0 = level * np.random.default_rng(3).standard_normal(8)
    recovery = rest_then_move(forgetting, 50_000, z0)
    assert recovery.finite
    assert recovery.frames <= 40


@pytest.mark.parametrize("forgetting", [0.9, 0.99])
def test_rest_does_not_wear_the_prior_down(forgetting: float) -> None:
    sizes = EstimatorSettings(8, 2, 1, forgetting=forgetting)
    R = at_rest(sizes, 20_000, np.zeros(8)).R
    left = np.diag(R.T @ R) / sizes.rho
    assert np.all(left > 0.99 * forgetting ** (sizes.refill_stride * 17))
    assert np.all(left < 1 + 1e-9)


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
@pytest.mark.parametrize(
    ("w", "y", "complaint"),
    [
        (np.zeros(16), np.zeros(8), r"\(17,\) and \(8,\)"),
        (np.zeros(17), np.zeros(9), r"\(17,\) and \(8,\)"),
        (np.zeros(18), np.zeros(7), r"\(17,\) and \(8,\)"),
        (np.full(17, np.nan), np.zeros(8), "not finite"),
        (np.zeros(17), np.full(8, np.inf), "not finite"),
        (np.full(17, 1e200), np.zeros(8), "magnitudes up to"),
    ],
)
def test_a_bad_measurement_is_refused_and_changes_nothing(
    forgetting: float, w: np.ndarray, y: np.ndarray, complaint: str
) -> None:
    sizes = EstimatorSettings(8, 2, 1, forgetting=forgetting)
    factor = single.init(sizes)
    with pytest.raises(ValueError, match=complaint):
        single.update(factor, sizes, w, y)
    assert factor.steps == 0
    assert np.array_equal(factor.R, np.sqrt(sizes.rho) * np.eye(17))
    assert not factor.D.any()
