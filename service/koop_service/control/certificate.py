"""Whether a learned model is fit for control, in numbers and in words.

Three questions: can every unstable mode be steered (Popov, Belevitch, Hautus); is B known, or was
the control never moved apart from the state; does the model still predict the next code as well as
it used to. A doubt is measured by the posterior: columns of Theta have covariance S C_jj, with
C = (R^T R)^{-1} (see `estimation/posterior.py`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_service.estimation.posterior import regressor_leverage
from koop_service.prediction.model import LinearModel

from .bounds import control_range
from .probing import middle_and_reach, multisine

Array = NDArray[np.float64]

#: A mode that grows less than this a step is drift: fresh codes keep up with it.
DRIFT = 1.01
#: Standard deviations by which an unstable mode's gain must differ from none.
MODE_SCORE = 2.5
#: The same for a column of B.
COLUMN_SCORE = 1.5
#: How many times the prior's information a control's data must have, if the prior knows nothing.
INFORMATION = 10.0
# Relative to the pair's size: a margin below it is zero up to rounding.
_UNREACHED = 1e-9

# The scores are set by 200 simulated plants at the takeover of `koop-eval control`, all of which
# the model then drives: 98% of unstable modes score above 2.5, 93% of B above 1.5; with another
# plant's controls 93% of B score below 1.5. The band by 12 recorded cartpoles of 400 frames: the
# ratio of ten residuals to S is below 1.7 in 99% and below 2 in 99.9% of frames.


class Mode(NamedTuple):
    """An eigenvalue of the companion matrix with modulus 1 or more.

    margin: smallest singular value of [lambda I - F, G] (G for controls in units of their half
    range): how little must change for no control to reach the mode. score: its gain from the
    controls over that gain's standard deviation.
    """

    eigenvalue: complex
    margin: float
    score: float


@dataclass(frozen=True, eq=False)
class Certificate:
    """The verdict, why, and what it rests on.

    fit: no reason against control was found. reasons: in words, what was found and expected.
    modes: those not stable, fastest growing first. stabilisable: each of them is steered (or just
    drifts). scores: (p,) |B_j| over its standard deviation. information: (p,) what is known of
    B_j, all else being unknown, over what a prior says that knows nothing. residual: root mean
    square of the recent one-step residuals over the usual one; band: below which it is usual.
    probing: (T, p) an input that would let the model be learned; None where it is fit.
    """

    fit: bool
    reasons: tuple[str, ...]
    modes: tuple[Mode, ...]
    stabilisable: bool
    scores: Array
    information: Array
    residual: float
    band: float
    probing: Array | None


def certify(
    model: LinearModel,
    S: Array,
    R: Array,
    ignorance: float,
    innovations: Array,
    u_min: ArrayLike | None = None,
    u_max: ArrayLike | None = None,
    du_min: ArrayLike | None = None,
    du_max: ArrayLike | None = None,
    *,
    seed: int = 0,
) -> Certificate:
    """Judge a model after its warm-up.

    S: (n, n) covariance of the one-step residual. R: (d, d) the estimator's factor, R^T R = W W^T +
    rho I; it knows what the estimator remembers, all since the start where nothing is forgotten.
    ignorance: weight of a prior that knows nothing, 0 where B was known before this trajectory's
    data said anything (`EstimatorSettings.ignorance`).
    innovations: (K, n), the last K normalised ones (say 10); with none the residual is 0.
    Bounds as for `build_lqr`, for the margin's units and the probing input. Raises ValueError for
    shapes that do not fit and a model without controls.
    """
    _check(model, S, R, innovations)
    p = model.control_size
    C = _column_variances(model, R)
    _, reach = middle_and_reach(*control_range(u_min, u_max, p))
    modes = unstable_modes(model, S, C, reach)
    lost = [mode for mode in modes if not _is_steered(model, mode)]
    scores = _ratio(np.linalg.norm(model.B, axis=0), np.sqrt(np.trace(S) * C))
    information = _ratio(np.ones(p), ignorance * C)
    residual, band = _residual(innovations, S)
    reasons = (
        *(_why_lost(mode) for mode in lost),
        *(_why_unknown(j, scores[j], information[j]) for j in range(p)),
        _why_surprised(len(innovations), residual, band),
    )
    found = tuple(reason for reason in reasons if reason)
    probing = None
    if found:
        probing = multisine(3 * len(R), p, u_min, u_max, du_min, du_max, seed=seed)
    return Certificate(
        not found, found, modes, not lost, scores, information, residual, band, probing
    )


def unstable_modes(model: LinearModel, S: Array, C: Array, reach: Array) -> tuple[Mode, ...]:
    """Modes with modulus 1 or more, one of a conjugate pair, fastest growing first.

    C: (p,) variances of B's columns in units of S. reach: (p,) half ranges of the controls.
    """
    F, G = model.companion(), model.companion_input()
    n, identity = model.code_size, np.eye(len(F))
    eigenvalues, left = np.linalg.eig(F.T)
    modes: list[Mode] = []
    for k in np.argsort(-np.abs(eigenvalues)):
        eigenvalue, w = complex(eigenvalues[k]), left[-n:, k]
        if abs(eigenvalue) < 1.0 or eigenvalue.imag < 0.0:
            continue
        pencil = np.concatenate([eigenvalue * identity - F, G * reach], axis=1)
        margin = float(np.linalg.svd(pencil, compute_uv=False)[-1])
        # A left eigenvector sees the new code through its last n entries: so it sees B.
        deviation = np.sqrt(np.maximum((w.conj() @ S @ w).real, 0.0) * C)
        modes.append(Mode(eigenvalue, margin, float(_ratio(np.abs(w @ model.B), deviation).max())))
    return tuple(modes)


def _check(model: LinearModel, S: Array, R: Array, innovations: Array) -> None:
    n, hn = model.A.shape
    p = model.control_size
    if p == 0:
        raise ValueError("the model has no control input (p = 0); expected an actuated system")
    if S.shape != (n, n) or innovations.ndim != 2 or innovations.shape[1] != n:
        raise ValueError(
            f"S has shape {S.shape}, the innovations {innovations.shape}; expected ({n}, {n}) and"
            f" (K, {n})"
        )
    if R.ndim != 2 or R.shape[0] != R.shape[1] or R.shape[0] - hn - p not in (0, 1):
        raise ValueError(
            f"R has shape {R.shape}; expected (d, d) with d = {hn + p}, or 1 more when affine"
        )


def _column_variances(model: LinearModel, R: Array) -> Array:
    """C_jj (p,) of the controls' columns."""
    hn, p = model.A.shape[1], model.control_size
    return regressor_leverage(R, np.eye(len(R))[hn : hn + p])


def _ratio(size: Array, deviation: Array) -> Array:
    """size / deviation, 0 of nothing; without noise a size is infinitely certain."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(size > 0.0, size / deviation, 0.0)
    return ratio.astype(np.float64)


def _is_steered(model: LinearModel, mode: Mode) -> bool:
    if abs(mode.eigenvalue) < DRIFT:
        return True
    size = abs(mode.eigenvalue) + float(np.abs(model.A).max())
    return mode.score >= MODE_SCORE and mode.margin > _UNREACHED * size


def _residual(innovations: Array, S: Array) -> tuple[float, float]:
    """Recent residuals over the usual ones, and the band: 2 for ten of them, 1.5 for forty."""
    if not len(innovations):
        return 0.0, np.inf
    recent = np.linalg.norm(innovations, axis=(0, 1), keepdims=True) / np.sqrt(len(innovations))
    ratio = _ratio(recent, np.sqrt(np.trace(S)))
    return float(ratio.item()), 1.0 + float(np.sqrt(10.0 / len(innovations)))


def _why_lost(mode: Mode) -> str:
    growth = 100.0 * (abs(mode.eigenvalue) - 1.0)
    return (
        f"a mode that grows by {growth:.0f}% a step is not steered: its gain from the controls is"
        f" {mode.score:.2f} standard deviations (margin {mode.margin:.1e}); expected"
        f" {MODE_SCORE:g} or more"
    )


def _why_unknown(channel: int, score: float, information: float) -> str:
    if information < INFORMATION:
        return (
            f"control {channel} was hardly moved apart from the state: the data say"
            f" {information:.1f} times what the prior says; expected {INFORMATION:.0f} or more"
        )
    if score < COLUMN_SCORE:
        return (
            f"what control {channel} does is not known: its effect is {score:.2f} standard"
            f" deviations; expected {COLUMN_SCORE:g} or more"
        )
    return ""


def _why_surprised(count: int, residual: float, band: float) -> str:
    if residual <= band:
        return ""
    return (
        f"the last {count} codes are {residual:.1f} times as far from their predictions as usual;"
        f" expected at most {band:.1f}: the system may have changed, let the model learn it again"
    )
