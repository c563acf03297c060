"""Eq. 13 as a condensed quadratic programme in the controls only.

    min_u  sum_{t=1..N} (z_t - z_f)^T Q (z_t - z_f) + sum_{t=0..N-1} u_t^T R u_t
    s.t.   z_{t+1} = A [z_{t-h+1}; ...; z_t] + B u_t + c,   u_min <= u_t <= u_max

z_0 is the newest measured code. The codes are linear in the controls, so the equality constraints
are substituted away. The target counts at every step: h steps in a row on it are at rest there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import affine_response, check_history

from .weights import LqrWeights

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LqrProblem:
    """Eq. 13 without its bounds; raises ValueError with what was wrong and what was expected.

    history: (h, n) measured codes, oldest first. target: (n,), the code z_f to reach and rest at.
    horizon: N, steps of one frame interval.
    """

    model: LinearModel
    history: Array
    target: Array
    horizon: int
    weights: LqrWeights

    @classmethod
    def parse(
        cls,
        model: LinearModel,
        history: Array,
        target: Array,
        horizon: int,
        Q: ArrayLike,
        R: ArrayLike,
    ) -> "LqrProblem":
        """Check the arguments; Q and R may be a number, a diagonal or a matrix."""
        n, p = model.code_size, model.control_size
        if p == 0:
            raise ValueError("the model has no control input (p = 0); expected an actuated system")
        if isinstance(horizon, bool) or not float(horizon).is_integer() or horizon < 1:
            raise ValueError(f"horizon is {horizon}; expected a whole number of steps, 1 or more")
        target = np.asarray(target, dtype=np.float64)
        if target.shape != (n,):
            raise ValueError(f"target has shape {target.shape}; expected ({n},), a code")
        if not np.isfinite(target).all():
            raise ValueError("target has NaN or infinity; expected finite numbers")
        history = check_history(model, history)
        return cls(model, history, target, int(horizon), LqrWeights.parse(Q, R, n, p))


@dataclass(frozen=True, eq=False)
class CondensedQP:
    """min 1/2 u^T H u + g^T u + constant, lower <= u <= upper; u is (N*p,), first step first.

    H: (N*p, N*p) symmetric, positive definite as far as rounding lets it. g, lower, upper: (N*p,);
    bounds may be infinite. The value is eq. 13's cost, its constant terms included. An unstable
    model over a long horizon can overflow H and g to infinity: `solve_qp` reports that.
    """

    H: Array
    g: Array
    lower: Array
    upper: Array
    constant: float
    control_size: int

    def cost(self, u: Array) -> float:
        """Eq. 13's cost of u, (N, p) or flat."""
        u = u.reshape(-1)
        return float(0.5 * u @ (self.H @ u) + self.g @ u + self.constant)

    def gradient(self, u: Array) -> Array:
        """Derivative of the cost by u, flat (N*p,)."""
        return self.H @ u.reshape(-1) + self.g


def build_lqr(
    model: LinearModel,
    history: Array,
    target: Array,
    horizon: int,
    Q: ArrayLike,
    R: ArrayLike,
    u_min: ArrayLike | None = None,
    u_max: ArrayLike | None = None,
) -> CondensedQP:
    """Condense eq. 13 from `history` (h, n), oldest first, to `target` (n,) over `horizon` N.

    Q (n, n) positive semidefinite and R (p, p) positive definite; each may be a number (times the
    identity), a vector (diagonal) or a matrix. u_min, u_max: a number or (p,), in the controls'
    unit, infinite or None where unbounded. Raises ValueError for anything else.
    """
    problem = LqrProblem.parse(model, history, target, horizon, Q, R)
    lower, upper = _bounds(u_min, u_max, model.control_size)
    return condense(problem, lower, upper)


def condense(problem: LqrProblem, lower: Array, upper: Array) -> CondensedQP:
    """Substitute the roll-out into eq. 13; `lower` and `upper` (p,) hold at every step."""
    model, N, weights = problem.model, problem.horizon, problem.weights
    with np.errstate(over="ignore", invalid="ignore"):
        free, markov = affine_response(model, problem.history, N)
        error = free - problem.target
        slope = error @ weights.Q
        return CondensedQP(
            H=2.0 * _quadratic(markov, weights),
            g=2.0 * _linear(markov, slope),
            lower=np.concatenate([lower] * N),
            upper=np.concatenate([upper] * N),
            constant=float(np.sum(slope * error)),
            control_size=model.control_size,
        )


def _quadratic(markov: Array, weights: LqrWeights) -> Array:
    """G^T (I x Q) G + I x R (N*p, N*p), G block Toeplitz of the Markov parameters M (N, n, p).

    Entry (a, b) sums M_{t-1-a}^T Q M_{t-1-b} over t > max(a, b): a partial sum along a diagonal of
    all products. Counted from the last control backwards, each row adds to the one before.
    """
    N, n, p = markov.shape
    M = markov.transpose(1, 0, 2).reshape(n, N * p)
    K = M.T @ weights.Q @ M
    K[:p, :p] += weights.R  # the running sums below carry R along the diagonal
    for i in range(p, N * p, p):
        K[i : i + p, p:] += K[i - p : i, :-p]
    return K.reshape(N, p, N, p)[::-1, :, ::-1, :].reshape(N * p, N * p)


def _linear(markov: Array, slope: Array) -> Array:
    """G^T v (N*p,): entry a sums M_{t-1-a}^T v_t over t > a; v (N, n) is Q (free code - target)."""
    N, n, p = markov.shape
    M, v = markov.reshape(N * n, p), slope.reshape(-1)
    return np.concatenate([v[a * n :] @ M[: (N - a) * n] for a in range(N)])


def _bounds(u_min: ArrayLike | None, u_max: ArrayLike | None, p: int) -> tuple[Array, Array]:
    lower = _bound("u_min", -np.inf if u_min is None else u_min, p)
    upper = _bound("u_max", np.inf if u_max is None else u_max, p)
    if (lower > upper).any() or (lower == np.inf).any() or (upper == -np.inf).any():
        raise ValueError(
            f"u_min is {lower.tolist()} and u_max {upper.tolist()}; expected u_min <= u_max, with a"
            " finite control between them"
        )
    return lower, upper


def _bound(name: str, value: ArrayLike, p: int) -> Array:
    bound = np.asarray(value, dtype=np.float64)
    if bound.shape not in ((), (p,)):
        raise ValueError(f"{name} has shape {bound.shape}; expected a number or ({p},)")
    if np.isnan(bound).any():
        raise ValueError(f"{name} has NaN; expected numbers, infinite where there is no bound")
    return np.broadcast_to(bound, (p,))
