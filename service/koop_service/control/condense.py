"""Eq. 13 with the dynamics substituted away: a quadratic programme in the controls only.

The codes are linear in the controls, z_t = free_t + sum_s M_{t-1-s} u_s, so that the cost is
quadratic in them; M are the Markov parameters.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from koop_service.prediction.rollout import affine_response

from .bounds import ControlBounds
from .objective import LqrProblem

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CondensedQP:
    """min 1/2 u^T H u + g^T u + constant in bounds on u and its changes; first step first.

    H: (N*p, N*p) symmetric, positive definite as far as rounding lets it. g, lower, upper: (N*p,);
    bounds may be infinite. rate_lower, rate_upper: ((N-1)*p,) bounds on `changes`, or empty where
    none has one. The value is the problem's cost, its constant terms included. An unstable
    model over a long horizon can overflow H and g to infinity: `solve_qp` reports that.
    """

    H: Array
    g: Array
    lower: Array
    upper: Array
    constant: float
    control_size: int
    rate_lower: Array = field(default_factory=lambda: np.zeros(0))
    rate_upper: Array = field(default_factory=lambda: np.zeros(0))

    def cost(self, u: Array) -> float:
        """The problem's cost of u, (N, p) or flat."""
        u = u.reshape(-1)
        return float(0.5 * u @ (self.H @ u) + self.g @ u + self.constant)

    def gradient(self, u: Array) -> Array:
        """Derivative of the cost by u, flat (N*p,)."""
        return self.H @ u.reshape(-1) + self.g

    def changes(self, u: Array) -> Array:
        """What the rate bounds are about: u_t - u_{t-1} for t >= 1, flat; or empty."""
        if not len(self.rate_lower):
            return np.zeros(0)
        u = u.reshape(-1)
        return u[self.control_size :] - u[: -self.control_size]

    def pull(self, multipliers: Array) -> Array:
        """What multipliers (like `changes`) of the rate bounds add to the gradient (N*p,)."""
        total = np.zeros(len(self.g))
        if len(multipliers):
            total[self.control_size :] += multipliers
            total[: -self.control_size] -= multipliers
        return total

    def rate_rows(self) -> Array:
        """The matrix of `changes`, ((N-1)*p or 0, N*p)."""
        unit = np.eye(len(self.g))
        return (unit[self.control_size :] - unit[: -self.control_size])[: len(self.rate_lower)]


def condense(problem: LqrProblem, bounds: ControlBounds) -> CondensedQP:
    """Substitute the roll-out into the problem's cost."""
    weights, h = problem.weights, problem.model.history
    with np.errstate(over="ignore", invalid="ignore"):
        free, markov = affine_response(problem.model, problem.history, problem.horizon)
        reach = _last_state_response(markov, h)
        error = (free - problem.targets)[:-1]
        slope = error @ weights.Q
        rest = np.concatenate([problem.history, free])[-h:].reshape(-1) - problem.last_state
        pull = problem.Qf @ rest
        return CondensedQP(
            H=2.0 * _quadratic(markov, reach, problem),
            g=2.0 * (_linear(markov, slope) + reach.T @ pull),
            lower=bounds.lower.reshape(-1),
            upper=bounds.upper.reshape(-1),
            constant=float(np.sum(slope * error) + rest @ pull),
            control_size=problem.model.control_size,
            rate_lower=bounds.rate_lower.reshape(-1),
            rate_upper=bounds.rate_upper.reshape(-1),
        )


def _last_state_response(markov: Array, h: int) -> Array:
    """What controls (N*p,) add to x_N: (hn, N*p), of the Markov parameters (N, n, p).

    Where N < h, the oldest of x_N's codes are measured ones: no control moves them.
    """
    N, n, p = markov.shape
    response = np.zeros((h, n, N, p))
    for age in range(min(h, N)):  # of z_{N-age}, which the last `age` controls do not reach
        response[h - 1 - age, :, : N - age] = markov[: N - age][::-1].transpose(1, 0, 2)
    return response.reshape(h * n, N * p)


def _quadratic(markov: Array, reach: Array, problem: LqrProblem) -> Array:
    """sum_t G_t^T Q G_t + reach^T Qf reach + I x R (N*p, N*p), G_t the response of z_t, t < N.

    Entry (a, b) sums M_{t-1-a}^T Q M_{t-1-b} over t > max(a, b): a partial sum along a diagonal of
    all products. Counted from the last control backwards, each row adds to the one before.
    """
    N, n, p = markov.shape
    M = markov[:-1].transpose(1, 0, 2).reshape(n, (N - 1) * p)
    K = M.T @ problem.weights.Q @ M
    if N > 1:  # the running sums below carry R along the diagonal
        K[:p, :p] += problem.weights.R
    for i in range(p, (N - 1) * p, p):
        K[i : i + p, p:] += K[i - p : i, :-p]
    H = reach.T @ problem.Qf @ reach
    blocks = H.reshape(N, p, N, p)  # a view: the last control changes no code before z_N
    blocks[:-1, :, :-1] += K.reshape(N - 1, p, N - 1, p)[::-1, :, ::-1]
    blocks[-1, :, -1] += problem.weights.R
    return H


def _linear(markov: Array, slope: Array) -> Array:
    """sum_t G_t^T v_t (N*p,): entry a sums M_{t-1-a}^T v_t over t > a; v (N-1, n)."""
    N, n, p = markov.shape
    M, v = markov.reshape(N * n, p), slope.reshape(-1)
    return np.concatenate([v[a * n :] @ M[: (N - 1 - a) * n] for a in range(N)])
