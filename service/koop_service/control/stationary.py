"""Control for ever: the discrete algebraic Riccati equation on the companion form (eq. 10).

    P = Q_x + F^T P (I + G R^-1 G^T P)^-1 F,      u = -K x,   K = (R + G^T P G)^-1 G^T P F

with Q_x the weight Q on the newest code of the state. Solved by structured doubling (Chu, Fan, Lin,
Wang 2004): iterate k is the cost P_k of 2^k steps, and F_k what the best controls leave of the
state after them. So F_k -> 0 proves the closed loop stable.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from koop_service.prediction.model import LinearModel

Array = NDArray[np.float64]

# 2^30 steps: a mode that has not died by then does not.
_DOUBLINGS = 30
_ACCURACY = 1e-10


class _Steps(NamedTuple):
    """2^k steps at once: x -> F x under the best controls, S what these can reach, P the cost."""

    F: Array
    S: Array
    P: Array


def stationary_cost(model: LinearModel, Q: Array, R: Array) -> Array | None:
    """P (hn, hn): x^T P x is what going on for ever from x costs, its own x^T Q_x x included.

    Q: (n, n) on codes, R: (p, p) on controls. For the model without its constant, which shifts
    the equilibrium only. None where no control makes the model stable (or none that Q asks for).
    """
    G = model.companion_input()
    steps = _Steps(model.companion(), G @ np.linalg.solve(R, G.T), state_weight(model, Q))
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            try:
                before, steps = steps, _double(steps)
            except np.linalg.LinAlgError:
                return None
            if _has_settled(before, steps):
                return steps.P if np.isfinite(steps.P).all() else None
    return None


def stationary_gain(model: LinearModel, R: Array, P: Array) -> Array:
    """K (p, hn) of the best control u = -K x, given `stationary_cost`'s P."""
    F, G = model.companion(), model.companion_input()
    GP = G.T @ P
    return np.asarray(np.linalg.solve(R + GP @ G, GP @ F), dtype=np.float64)


def state_weight(model: LinearModel, Q: Array) -> Array:
    """Q (n, n) as a weight (hn, hn) on the companion state: on its newest code."""
    n, hn = model.A.shape
    weight = np.zeros((hn, hn))
    weight[hn - n :, hn - n :] = Q
    return weight


def _double(steps: _Steps) -> _Steps:
    """Twice as many."""
    F, S, P = steps
    size = len(F)
    solved = np.linalg.solve(np.eye(size) + S @ P, np.concatenate([F, S], axis=1))
    S_after, P_after = S + F @ solved[:, size:] @ F.T, P + F.T @ P @ solved[:, :size]
    return _Steps(F @ solved[:, :size], 0.5 * (S_after + S_after.T), 0.5 * (P_after + P_after.T))


def _has_settled(before: _Steps, after: _Steps) -> bool:
    change, size = np.abs(after.P - before.P).max(), np.abs(after.P).max()
    return bool(np.abs(after.F).max() < _ACCURACY and change <= _ACCURACY * size)
