"""Standard deviations of a roll-out: process noise plus what is not known about the model.

The posterior of Theta is matrix-normal, Theta = mean + S^{1/2} N R^{-T} with N (n, d) standard
normal: row covariance S, column covariance (R^T R)^{-1}. One wrong Theta acts at every step, so its
errors add up coherently instead of averaging out: to first order each column of N is an impulse
train v_0, v_1, ... (v_t = R^{-T} w_t) through the model, while the noise enters once a step. At one
step this is exactly S (1 + w^T (R^T R)^{-1} w).

Where measurements say nothing about Theta, that says it is known to within S / rho, rho being the
prior's weight: far too sure where the residual is small. There the prior pulls Theta toward its
centre, off by rho (R^T R)^{-1} times what Theta differs from it by, with variance PRIOR_VARIANCE.

All this takes the residual for white noise of the plant. An encoder's is not: where most of it is
the error of single codes it does not add up over the steps, where the plant is not linear it adds
up faster. `calibrated` makes up for it by what was measured on trajectories held out of training.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from koop_service.estimation.triangular import back_substitute, forward_substitute

from .model import LinearModel
from .rollout import forced_response, impulse_response, regressors, rollout

Array = NDArray[np.float64]

PRIOR_VARIANCE = 0.1
"""Of a coefficient of which nothing is known; those of three actuated models have 0.02 to 0.13."""

SCALE_HORIZONS = (1, 2, 5, 10, 20)
"""Steps ahead at which it is measured how much wider or narrower the bands must be."""


def rollout_std(
    model: LinearModel, history: Array, controls: Array, S: Array, R: Array, rho: float = 0.0
) -> Array:
    """Standard deviations (H, n) of `rollout(model, history, controls)`, in code units.

    S: (n, n) covariance of the one-step residual. R: (d, d) upper triangular, the estimator's
    factor, R^T R = W W^T + rho I; d = h*n + p, plus 1 when the estimator is affine. rho: the
    prior's weight, if it knows nothing; with 0 nothing is added for what the prior decided.
    The measured history is taken as exact. Raises ValueError for shapes that do not fit.
    """
    codes = rollout(model, history, controls)
    W = _with_constant(regressors(history, codes, controls), R)
    if S.shape != (model.code_size, model.code_size):
        raise ValueError(f"S has shape {S.shape}; expected (n, n) with n = {model.code_size}")
    root = _root(S)
    with np.errstate(over="ignore", invalid="ignore"):
        noise = impulse_response(model, root, len(codes))
        variance = np.cumsum(_power(noise), axis=0) + _parameters(model, W, R, root, rho)
        # A diverging roll-out ends in inf - inf; nothing is known about it then.
        return np.sqrt(np.where(np.isnan(variance), np.inf, variance))


def calibrated(std: Array, scale: Sequence[float]) -> Array:
    """Standard deviations `std` (H, n) of a roll-out, each step's times what its horizon needs.

    scale: factors at SCALE_HORIZONS; between two of them the factor is linear in the logarithm of
    the horizon, beyond the last it is the last. Without factors, `std` as it is.
    """
    if not scale:
        return std
    steps = np.log(np.arange(1, len(std) + 1))
    return std * np.interp(steps, np.log(SCALE_HORIZONS), scale)[:, None]


def _with_constant(W: Array, R: Array) -> Array:
    """Regressors (H, d) in the factor's size: with a 1 at the end where the estimator is affine."""
    d = R.shape[0]
    if R.shape != (d, d) or d - W.shape[1] not in (0, 1):
        raise ValueError(
            f"R has shape {R.shape}; expected (d, d) with d = {W.shape[1]}, or 1 more when affine"
        )
    return np.concatenate([W, np.ones((len(W), d - W.shape[1]))], axis=1)


def _root(S: Array) -> Array:
    """A square root of a covariance, also of a singular one (a dead code has no noise)."""
    eigenvalues, vectors = np.linalg.eigh(S)
    return vectors * np.sqrt(np.maximum(eigenvalues, 0.0))


def _parameters(model: LinearModel, W: Array, R: Array, root: Array, rho: float) -> Array:
    """Variances (H, n) of what is not known about Theta: by its posterior, and by its prior."""
    triangle, V = np.ascontiguousarray(R), W.T.copy()
    forward_substitute(triangle, V)
    variance = _power(forced_response(model, _impulses(V, root)))
    if rho > 0:
        back_substitute(triangle, V)
        prior = np.sqrt(PRIOR_VARIANCE) * np.eye(len(root))
        variance += _power(forced_response(model, _impulses(rho * V, prior)))
    return variance


def _impulses(V: Array, root: Array) -> Array:
    """Forcing (H, n, n*d) of V (d, H): at step t, column block j is V[j, t] times the root."""
    d, horizon = V.shape
    return np.einsum("jt,ab->tajb", V, root).reshape(horizon, len(root), d * len(root))


def _power(responses: Array) -> Array:
    """Row sums of squares (H, n) of responses (H, n, m)."""
    return np.einsum("tam,tam->ta", responses, responses)
