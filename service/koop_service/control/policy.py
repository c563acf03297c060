"""The cheap alternative to a plan: the infinite horizon's gain, cut off at the bounds.

Where no bound is active it is the optimum of an endless eq. 13 about the equilibrium nearest to the
target; where one is, it knows nothing of it beforehand, as a plan does.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import check_history

from .bounds import control_range, first_step, rate_range
from .equilibrium import Equilibrium, nearest_equilibrium
from .stationary import stationary_cost, stationary_gain
from .weights import LqrWeights

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StationaryPolicy:
    """u = u_s - K (x - x_s) within bounds; made by `stationary_policy`.

    K: (p, hn) on the companion state. rest: the equilibrium (z_s, u_s), x_s repeats z_s.
    bounds, rates: (lower, upper), each (p,), of a control and of its change in one step.
    """

    model: LinearModel
    K: Array
    rest: Equilibrium
    bounds: tuple[Array, Array]
    rates: tuple[Array, Array]

    def control(self, history: Array, last_control: Array | None = None) -> Array:
        """The control (p,) now, after codes `history` (h, n); the rates need the last one (p,)."""
        return self._control(check_history(self.model, history).reshape(-1), last_control)

    def plan(self, history: Array, horizon: int, last_control: Array | None = None) -> Array:
        """Controls (N, p) that the policy expects to apply."""
        x = check_history(self.model, history).reshape(-1)
        A, B, c, n = self.model.A, self.model.B, self.model.c, self.model.code_size
        controls = np.empty((horizon, len(self.K)))
        for t in range(horizon):
            controls[t] = last_control = self._control(x, last_control)
            x = np.concatenate([x[n:], A @ x + B @ controls[t] + c])
        return controls

    def _control(self, x: Array, last_control: Array | None) -> Array:
        """The control in state x (hn,)."""
        x_s = np.concatenate([self.rest.code] * self.model.history)
        u = self.rest.control - self.K @ (x - x_s)
        low, high = self.bounds
        if last_control is not None:
            slowest, fastest = self.rates
            low, high = first_step(low, high, last_control + slowest, last_control + fastest)
        return np.minimum(np.maximum(u, low), high)

    def radius(self) -> float:
        """Largest eigenvalue modulus of the closed loop, below 1: how fast deviations die."""
        closed = self.model.companion() - self.model.companion_input() @ self.K
        return float(np.abs(np.linalg.eigvals(closed)).max())


def stationary_policy(
    model: LinearModel,
    target: Array,
    Q: ArrayLike,
    R: ArrayLike,
    u_min: ArrayLike | None = None,
    u_max: ArrayLike | None = None,
    du_min: ArrayLike | None = None,
    du_max: ArrayLike | None = None,
) -> StationaryPolicy | None:
    """The gain towards `target` (n,); None where no control makes the model stable.

    Arguments and errors as in `build_lqr`.
    """
    if model.control_size == 0:
        raise ValueError("the model has no control input (p = 0); expected an actuated system")
    weights = LqrWeights.parse(Q, R, model.code_size, model.control_size)
    P = stationary_cost(model, weights.Q, weights.R)
    if P is None:
        return None
    return StationaryPolicy(
        model,
        stationary_gain(model, weights.R, P),
        nearest_equilibrium(model, target, u_min, u_max),
        control_range(u_min, u_max, model.control_size),
        rate_range(du_min, du_max, model.control_size),
    )
