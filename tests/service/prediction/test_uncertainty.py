"""Predicted standard deviations against sampling, and their coverage on linear-Gaussian data."""

import numpy as np
import pytest

from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import regressors, rollout
from koop_service.prediction.uncertainty import (
    PRIOR_VARIANCE,
    SCALE_HORIZONS,
    calibrated,
    rollout_std,
)

NORMAL_90 = 1.6448536269514722


def oscillator(affine=False):
    """A damped, coupled, driven two-code system with history 2."""
    A = np.array([[-0.80, 0.10, 1.70, 0.05], [0.0, -0.50, 0.10, 1.20]])
    return LinearModel(A, np.array([[0.3], [0.1]]), np.array([0.2, -0.1]) * affine)


def theta_of(model, affine):
    return np.hstack([model.A, model.B] + [model.c[:, None]] * affine)


def model_of(Theta):
    c = Theta[:, 5] if Theta.shape[1] == 6 else np.zeros(2)
    return LinearModel(Theta[:, :4], Theta[:, 4:5], c)


def simulate(model, history, controls, noise):
    trajectory = list(history)
    for u, e in zip(controls, noise, strict=True):
        x = np.concatenate(trajectory[-model.history :])
        trajectory.append(model.A @ x + model.B @ u + model.c + e)
    return np.array(trajectory)


def triangular(rng, d, size):
    return np.linalg.qr(rng.normal(size=(4 * d, d)))[1] * size


COVARIANCE = np.array([[2e-3, 1e-3], [1e-3, 1e-3]])


@pytest.mark.parametrize("affine", [False, True])
def test_one_step_is_the_predictive_covariance(affine):
    rng = np.random.default_rng(0)
    model, history, u = oscillator(affine), rng.normal(size=(2, 2)), rng.normal(size=(1, 1))
    w = np.concatenate([history.reshape(-1), u[0], [1.0] * affine])
    R = triangular(rng, len(w), 0.5)
    leverage = w @ np.linalg.inv(R.T @ R) @ w
    assert leverage > 0.05  # else the test could not see it
    expected = np.sqrt(np.diag(COVARIANCE) * (1.0 + leverage))
    np.testing.assert_allclose(
        rollout_std(model, history, u, COVARIANCE, R)[0], expected, rtol=1e-12
    )


@pytest.mark.parametrize("affine", [False, True])
def test_longer_horizons_agree_with_sampling_the_posterior(affine):
    rng = np.random.default_rng(1)
    model, horizon, samples = oscillator(affine), 12, 4000
    history, controls = rng.normal(size=(2, 2)), rng.normal(size=(horizon, 1))
    Theta = theta_of(model, affine)
    R = triangular(rng, Theta.shape[1], 0.8)
    S = 0.1 * COVARIANCE  # small enough for the linearisation in Theta
    root = np.linalg.cholesky(S)
    ends = np.empty((samples, horizon, 2))
    for i in range(samples):
        drawn = Theta + root @ rng.normal(size=Theta.shape) @ np.linalg.inv(R).T
        noise = rng.normal(size=(horizon, 2)) @ root.T
        ends[i] = simulate(model_of(drawn), history, controls, noise)[2:]
    std = rollout_std(model, history, controls, S, R)
    # 4,000 samples know a standard deviation to 1.1%.
    np.testing.assert_allclose(ends.std(axis=0), std, rtol=0.05)
    noise_only = rollout_std(model, history, controls, S, 1e9 * R)
    assert (std[-1] > 1.15 * noise_only[-1]).all()


def coverage(trials, *, parameters):
    """Share of true futures inside the 90% bands of a model fitted to 30 noisy frames."""
    rng = np.random.default_rng(2)
    truth, measured, horizon = oscillator(), 30, 8
    root = np.linalg.cholesky(COVARIANCE)
    inside = []
    for _ in range(trials):
        controls = rng.normal(size=(measured + horizon, 1))
        noise = rng.normal(size=(measured + horizon, 2)) @ root.T
        trajectory = simulate(truth, rng.normal(size=(2, 2)), controls, noise)
        past, future = trajectory[: measured + 2], trajectory[measured + 2 :]
        W = regressors(past[:2], past[2:], controls[:measured])
        R = np.linalg.qr(np.vstack([W, 1e-3 * np.eye(5)]))[1]
        model = model_of(np.linalg.solve(R.T @ R, W.T @ past[2:]).T)
        R = R if parameters else 1e9 * R
        codes = rollout(model, past[-2:], controls[measured:])
        std = rollout_std(model, past[-2:], controls[measured:], COVARIANCE, R)
        inside.append(np.abs(future - codes) < NORMAL_90 * std)
    return np.mean(inside)


def test_ninety_percent_bands_hold_ninety_percent():
    assert coverage(400, parameters=True) == pytest.approx(0.90, abs=0.025)


def test_without_parameter_covariance_the_bands_would_be_too_narrow():
    assert coverage(400, parameters=False) < 0.86


def test_no_noise_means_no_spread_and_a_singular_covariance_works():
    model, history, controls = oscillator(), np.ones((2, 2)), np.ones((5, 1))
    R = triangular(np.random.default_rng(3), 5, 1.0)
    np.testing.assert_array_equal(rollout_std(model, history, controls, np.zeros((2, 2)), R), 0.0)
    S = np.array([[1e-2, 0.0], [0.0, 0.0]])
    first = rollout_std(model, history, controls, S, R)[0]
    assert first[0] > 0.1
    assert first[1] == 0.0


@pytest.mark.filterwarnings("error")
def test_a_diverging_roll_out_is_infinitely_uncertain():
    model = LinearModel(np.array([[1e200]]), np.ones((1, 1)), np.zeros(1))
    std = rollout_std(model, np.ones((1, 1)), np.zeros((4, 1)), np.eye(1), np.eye(2))
    assert np.isfinite(std[0]).all()
    assert (std[-1] == np.inf).all()


@pytest.mark.parametrize(
    ("S", "R", "problem"),
    [
        (np.eye(3), np.eye(5), "S has shape"),
        (np.eye(2), np.eye(4), "R has shape"),
        (np.eye(2), np.eye(7), "R has shape"),
        (np.eye(2), np.ones((5, 6)), "R has shape"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(S, R, problem):
    with pytest.raises(ValueError, match=problem):
        rollout_std(oscillator(), np.ones((2, 2)), np.ones((3, 1)), S, R)


def test_what_the_prior_decides_adds_its_own_doubt():
    """Against the naive formula: Theta's bias is rho (R^T R)^{-1} times a random Theta."""
    rng = np.random.default_rng(4)
    model, history, u = oscillator(), rng.normal(size=(2, 2)), rng.normal(size=(1, 1))
    w = np.concatenate([history.reshape(-1), u[0]])
    rho = 0.3
    past = np.append(rng.normal(size=(40, 4)), np.zeros((40, 1)), axis=1)  # never a control
    R = np.linalg.qr(np.vstack([past, np.sqrt(rho) * np.eye(5)]))[1]
    P = np.linalg.inv(R.T @ R)
    std = rollout_std(model, history, u, COVARIANCE, R, rho)
    bias = PRIOR_VARIANCE * rho**2 * (w @ P @ P @ w)
    np.testing.assert_allclose(std[0] ** 2, np.diag(COVARIANCE) * (1 + w @ P @ w) + bias)
    # Of what a control does nothing is known but what the prior says.
    assert std[0].min() > np.sqrt(PRIOR_VARIANCE) * abs(u[0, 0])


def test_doubt_about_the_prior_also_adds_up_over_the_steps():
    rng = np.random.default_rng(5)
    model, horizon, samples, rho = oscillator(), 10, 4000, 0.05
    history, controls = rng.normal(size=(2, 2)), rng.normal(size=(horizon, 1))
    R = triangular(rng, 5, 1.0)
    pull = rho * np.sqrt(PRIOR_VARIANCE) * np.linalg.inv(R.T @ R)
    still = np.zeros((horizon, 2))
    ends = [
        simulate(
            model_of(theta_of(model, False) + rng.normal(size=(2, 5)) @ pull),
            history,
            controls,
            still,
        )
        for _ in range(samples)
    ]
    std = rollout_std(model, history, controls, np.zeros((2, 2)), R, rho)
    np.testing.assert_allclose(np.std(ends, axis=0)[2:], std, rtol=0.05)


SCALE = (1.0, 0.5, 2.0, 3.0, 0.1)


def test_calibration_at_its_own_horizons_and_beyond():
    std = np.linspace([1.0, 2.0], [3.0, 5.0], 30)
    factors = calibrated(std, SCALE) / std
    np.testing.assert_allclose(factors[:, 0], factors[:, 1])
    np.testing.assert_allclose(factors[np.array(SCALE_HORIZONS) - 1, 0], SCALE)
    np.testing.assert_allclose(factors[SCALE_HORIZONS[-1] :, 0], SCALE[-1])
    geometric = (np.log(7) - np.log(5)) / (np.log(10) - np.log(5))  # where 7 is between 5 and 10
    np.testing.assert_allclose(factors[6, 0], 2.0 + geometric)


def test_calibration_of_a_horizon_shorter_than_the_first_few_and_of_nothing_known():
    std = np.ones((1, 2))
    np.testing.assert_array_equal(calibrated(std, SCALE), std)
    np.testing.assert_array_equal(calibrated(2 * std, ()), 2 * std)
