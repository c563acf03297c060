"""Eq. 13 without bounds, by dynamic programming on the companion form (eq. 10).

The cost of going on from x = [z_{t-h+1}; ...; z_t] with the best controls is x^T P x + 2 q^T x plus
a constant. The linear term carries the target and the model's constant.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_service.prediction.model import LinearModel

from .objective import LqrProblem

Array = NDArray[np.float64]


class _Dynamics(NamedTuple):
    """x_{t+1} = F x_t + G u_t + f."""

    F: Array
    G: Array
    f: Array


class _Value(NamedTuple):
    """x^T P x + 2 q^T x + constant."""

    P: Array
    q: Array


class _Policy(NamedTuple):
    """u = -K x - k."""

    K: Array
    k: Array


def lqr_riccati(
    model: LinearModel,
    history: Array,
    target: ArrayLike,
    horizon: int,
    Q: ArrayLike,
    R: ArrayLike,
    *,
    Qf: ArrayLike | Literal["riccati"] | None = None,
) -> Array:
    """Controls (N, p) that minimise eq. 13 from `history` (h, n) to `target`; no bounds.

    Arguments and errors as in `build_lqr`.
    """
    problem = LqrProblem.parse(model, history, target, horizon, Q, R, Qf)
    dynamics = _Dynamics(model.companion(), model.companion_input(), model.companion_offset())
    return _forward(dynamics, problem.history.reshape(-1), _backward(dynamics, problem))


def _backward(dynamics: _Dynamics, problem: LqrProblem) -> list[_Policy]:
    """Policies for t = 0 ... N-1, from the last step back."""
    value = _Value(problem.Qf, -problem.Qf @ problem.last_state)
    policies: list[_Policy] = []
    for t in range(problem.horizon - 1, -1, -1):
        policy = _minimise(dynamics, value, problem.weights.R)
        value = _step_back(dynamics, value, policy, problem.weights.R)
        policies.append(policy)
        if t > 0:  # z_0 is given and costs nothing
            value = _with_stage(value, problem.weights.Q, problem.targets[t - 1])
    return policies[::-1]


def _with_stage(value: _Value, Q: Array, target: Array) -> _Value:
    """Add (z - r)^T Q (z - r) on the newest code z of the state, less its constant."""
    n = len(target)
    P, q = value.P.copy(), value.q.copy()
    P[-n:, -n:] += Q
    q[-n:] -= Q @ target
    return _Value(P, q)


def _minimise(dynamics: _Dynamics, value: _Value, R: Array) -> _Policy:
    """The policy that minimises u^T R u + V(F x + G u + f)."""
    F, G, f = dynamics
    GP = G.T @ value.P
    affine = GP @ f + G.T @ value.q
    gains = np.linalg.solve(R + GP @ G, np.column_stack([GP @ F, affine]))
    return _Policy(gains[:, :-1].astype(np.float64), gains[:, -1].astype(np.float64))


def _step_back(dynamics: _Dynamics, value: _Value, policy: _Policy, R: Array) -> _Value:
    """V_t from V_{t+1}; P in Joseph's form, a sum of squares that rounding cannot make negative."""
    closed = dynamics.F - dynamics.G @ policy.K
    P = closed.T @ value.P @ closed + policy.K.T @ R @ policy.K
    return _Value(P, closed.T @ (value.P @ dynamics.f + value.q))


def _forward(dynamics: _Dynamics, x: Array, policies: list[_Policy]) -> Array:
    controls = np.empty((len(policies), dynamics.G.shape[1]))
    for t, policy in enumerate(policies):
        controls[t] = -policy.K @ x - policy.k
        x = dynamics.F @ x + dynamics.G @ controls[t] + dynamics.f
    return controls
