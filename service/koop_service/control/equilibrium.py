"""Whether a target can be held: eq. 13 asks the codes to stay at z_f; a model may not allow it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_service.prediction.model import LinearModel

from .bounds import control_range
from .condense import CondensedQP
from .solve import solve_qp

Array = NDArray[np.float64]

# Relative to I - sum_i A_i squared: a mode nearer to an integrator than this counts as one.
_INTEGRATOR = 1e-12
# Of two controls that do the same, the smaller one.
_THRIFT = 1e-12
# What counts as off the target: noise, and share of the way. On recorded cartpoles (see
# certificate.py) upright is 1 to 8 times the noise away from an equilibrium of models learned near
# it, and 12 to 50 times of models learned elsewhere.
_CLEAR, _SHARE = 10.0, 0.2


class Equilibrium(NamedTuple):
    """Where the model can rest: z = sum_i A_i z + B u + c.

    code: (n,). control: (p,), what holds it. distance: from the target, in code units. drift: what
    the code still moves in a step, in code units; 0 unless the model can rest nowhere.
    """

    code: Array
    control: Array
    distance: float
    drift: float


def nearest_equilibrium(
    model: LinearModel,
    target: Array,
    u_min: ArrayLike | None = None,
    u_max: ArrayLike | None = None,
) -> Equilibrium:
    """The equilibrium within the bounds that is nearest to `target` (n,).

    Its distance is what is left of the way however long the horizon, so a target with a distance
    well above the code's noise is one that cannot be held. Raises ValueError as `build_lqr` does.
    """
    lower, upper = control_range(u_min, u_max, model.control_size)
    target = np.asarray(target, dtype=np.float64)
    if target.shape != (model.code_size,) or not np.isfinite(target).all():
        raise ValueError(f"target is {target}; expected a code, {model.code_size} finite numbers")
    E = np.eye(model.code_size) - model.A.reshape(model.code_size, model.history, -1).sum(1)
    # With z = target + x rest means E x = B u + start. The smallest x is E^T S (B u + start).
    start = model.c - E @ target
    gram = E @ E.T
    S = _inverse(gram + _INTEGRATOR * np.trace(gram) * np.eye(len(E)))
    u = _least(model.B.T @ S @ model.B, model.B.T @ S @ start, lower, upper)
    force = model.B @ u + start
    x = E.T @ S @ force
    distance, drift = np.linalg.norm(x), np.linalg.norm(force - E @ x)
    return Equilibrium(target + x, u, float(distance), float(drift))


def why_unreachable(rest: Equilibrium, target: Array, history: Array, S: Array) -> str:
    """Why `target` (n,) will not be held, `rest` being the nearest that is; "" where it is.

    It is not where the distance is far above the noise, S (n, n) the covariance of the one-step
    residual, and a good part of the way from the newest code of `history` (h, n). A model learned
    elsewhere says so too: it is right about itself, not about the system.
    """
    way = float(np.linalg.norm(history[-1] - target))
    noise = float(np.sqrt(np.trace(S)))
    if rest.distance <= _CLEAR * noise or rest.distance <= _SHARE * way:
        return ""
    return (
        f"the nearest code that the model can hold within the bounds is {rest.distance:.2g} from"
        f" the target, which is {way:.2g} away (noise {noise:.2g}); expected less: widen the"
        " bounds, choose another target, or let the model see more of the way"
    )


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _least(H: Array, g: Array, lower: Array, upper: Array) -> Array:
    """The u (p,) that minimises 1/2 u^T H u + g^T u in the box; H (p, p) may be singular."""
    thrift = _THRIFT * float(np.trace(H)) or 1.0
    problem = CondensedQP(H + thrift * np.eye(len(g)), g, lower, upper, 0.0, len(g))
    return solve_qp(problem).u[0]


def resting_control(model: LinearModel, target: Array) -> tuple[Array, Array]:
    """The constant control (p,) that best holds `target` (n,), and the drift (n,) that is left.

    The drift is the next code less the target when the whole history is the target: zero where the
    target is an equilibrium of the model. It bounds what `build_lqr` can reach from below.
    """
    still = np.tile(target, model.history)
    drift = model.A @ still + model.c - target
    u = np.asarray(np.linalg.lstsq(model.B, -drift, rcond=None)[0], dtype=np.float64)
    return u, drift + model.B @ u
