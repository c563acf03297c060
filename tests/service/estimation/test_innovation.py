"""Residual covariance and what the posterior says about a regressor."""

import numpy as np
import pytest

from koop_service.estimation import factor as single
from koop_service.estimation.innovation import MEMORY, RECENT, InnovationStatistics
from koop_service.estimation.posterior import (
    excitation,
    predictive_covariance,
    regressor_leverage,
)
from koop_service.estimation.settings import EstimatorSettings

from .strategies import Problem, folded

SIZES = EstimatorSettings(2, 1, 1)
WARMUP = SIZES.warmup_updates


def test_the_first_innovations_are_left_out() -> None:
    statistics = InnovationStatistics(SIZES, 1)
    statistics.fold(np.zeros(WARMUP, dtype=np.int64), np.full((WARMUP, 2), 1e6))
    assert statistics.rms(0) == 0.0
    statistics.fold(np.zeros(1, dtype=np.int64), np.array([[3.0, 4.0]]))
    np.testing.assert_allclose(statistics.covariance(0), [[9.0, 12.0], [12.0, 16.0]])
    assert statistics.rms(0) == pytest.approx(np.sqrt(12.5))
    assert statistics.seen(0) == WARMUP + 1


def test_the_mean_is_plain_at_first_and_exponential_later() -> None:
    E = np.random.default_rng(0).standard_normal((WARMUP + MEMORY + 50, 2))
    statistics = InnovationStatistics(SIZES, 3)
    statistics.fold(np.full(WARMUP + 100, 2), E[: WARMUP + 100])
    early = E[WARMUP : WARMUP + 100]
    np.testing.assert_allclose(statistics.covariance(2), early.T @ early / 100)
    statistics.fold(np.full(MEMORY - 50, 2), E[WARMUP + 100 :])
    S = E[WARMUP : WARMUP + MEMORY].T @ E[WARMUP : WARMUP + MEMORY] / MEMORY
    for e in E[WARMUP + MEMORY :]:
        S += (np.outer(e, e) - S) / MEMORY
    np.testing.assert_allclose(statistics.covariance(2), S, rtol=1e-10)
    assert not statistics.covariance(0).any()


def test_the_newest_are_kept_as_they_are_oldest_first() -> None:
    E = np.random.default_rng(0).standard_normal((WARMUP + 23, 2))
    statistics = InnovationStatistics(SIZES, 2)
    for end in (WARMUP, WARMUP + 1, WARMUP + 7, WARMUP + 10, WARMUP + 23):
        start = statistics.seen(1)
        statistics.fold(np.ones(end - start, dtype=np.int64), E[start:end])
        np.testing.assert_array_equal(statistics.recent(1), E[max(WARMUP, end - RECENT) : end])
    assert statistics.recent(0).shape == (0, 2)


def test_the_innovations_of_a_known_system_give_its_noise_covariance() -> None:
    rng = np.random.default_rng(0)
    noise = np.array([[0.3, 0.0], [0.2, 0.1]])
    W = rng.standard_normal((4000, 3))
    Y = W @ rng.standard_normal((3, 2)) + rng.standard_normal((4000, 2)) @ noise.T
    factor, statistics = single.init(SIZES), InnovationStatistics(SIZES, 1)
    mean = np.zeros((2, 2))
    for k, (w, y) in enumerate(zip(W, Y, strict=True)):
        e = single.update(factor, SIZES, w, y)
        statistics.fold(np.zeros(1, dtype=np.int64), e[None].copy())
        mean += statistics.covariance(0) / 3000 if k >= 1000 else 0.0
    np.testing.assert_allclose(mean, noise @ noise.T, atol=0.01)


def test_a_covariance_of_another_size_is_refused() -> None:
    statistics = InnovationStatistics(SIZES, 1)
    with pytest.raises(ValueError, match=r"expected \(2, 2\), finite"):
        statistics.insert(0, np.zeros((3, 3)), 5, np.zeros((RECENT, 2)))
    with pytest.raises(ValueError, match=r"expected \(2, 2\), finite"):
        statistics.insert(0, np.full((2, 2), np.nan), 5, np.zeros((RECENT, 2)))
    with pytest.raises(ValueError, match=r"the newest innovations have shape \(9, 2\)"):
        statistics.insert(0, np.zeros((2, 2)), 5, np.zeros((9, 2)))


def test_leverage_and_predictive_covariance_are_the_dense_formula() -> None:
    rng = np.random.default_rng(0)
    factor = folded(Problem(SIZES, rng.standard_normal((30, 3)), rng.standard_normal((30, 2))))
    P = np.linalg.inv(factor.R.T @ factor.R)
    w, S = rng.standard_normal((5, 3)), np.array([[2.0, 1.0], [1.0, 3.0]])
    wanted = np.einsum("ki,ij,kj->k", w, P, w)
    np.testing.assert_allclose(regressor_leverage(factor.R, w), wanted, rtol=1e-12)
    np.testing.assert_allclose(regressor_leverage(factor.R, w[0]), wanted[0], rtol=1e-12)
    covariance = predictive_covariance(S, factor.R, w[0])
    np.testing.assert_allclose(covariance, S * (1 + wanted[0]), rtol=1e-12)
    with pytest.raises(ValueError, match=r"expected \(d, d\) and"):
        regressor_leverage(factor.R, np.zeros(4))


def test_excitation_is_one_until_every_direction_was_excited() -> None:
    rng = np.random.default_rng(0)
    W, Y = rng.standard_normal((30, 3)), np.zeros((30, 2))
    everything = folded(Problem(SIZES, W, Y))
    assert excitation(everything.R, SIZES.rho) > 10
    W[:, 2] = W[:, 0]
    collinear = folded(Problem(SIZES, W, Y))
    assert excitation(collinear.R, SIZES.rho) == pytest.approx(1.0)
    assert excitation(single.init(SIZES).R, SIZES.rho) == pytest.approx(1.0)
