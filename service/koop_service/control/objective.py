"""Eq. 13 with the ends that a controller needs: what to reach, in how many steps, at which cost.

    min_u  sum_{t=1..N-1} (z_t - r_t)^T Q (z_t - r_t) + sum_{t=0..N-1} u_t^T R u_t
             + (x_N - x_f)^T Qf (x_N - x_f)
    s.t.   z_{t+1} = A [z_{t-h+1}; ...; z_t] + B u_t + c,   x_N = [z_{N-h+1}; ...; z_N]
           u_min <= u_t <= u_max,   du_min <= u_t - u_{t-1} <= du_max

z_0 is the newest measured code and u_{-1} the control that acts now. r_t is the target at step t,
and x_f repeats the last one, r_N: h codes in a row on it are at rest there. With Qf the weight Q on
z_N this is the paper's eq. 13.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import check_history

from .bounds import known_channels
from .weights import LqrWeights, terminal_weight

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LqrProblem:
    """The problem without its bounds; raises ValueError with what was wrong and what was expected.

    history: (h, n) measured codes, oldest first. targets: (N, n), row t-1 the code r_t to be on at
    step t. horizon: N, steps of one frame interval. Qf: (hn, hn).
    """

    model: LinearModel
    history: Array
    targets: Array
    horizon: int
    weights: LqrWeights
    Qf: Array

    @classmethod
    def parse(
        cls,
        model: LinearModel,
        history: Array,
        target: ArrayLike,
        horizon: int,
        Q: ArrayLike,
        R: ArrayLike,
        Qf: ArrayLike | Literal["riccati"] | None = None,
        known: Mapping[int, ArrayLike] | None = None,
    ) -> "LqrProblem":
        """Check the arguments of `build_lqr`."""
        n, p = model.code_size, model.control_size
        if p == 0:
            raise ValueError("the model has no control input (p = 0); expected an actuated system")
        if isinstance(horizon, bool) or not float(horizon).is_integer() or horizon < 1:
            raise ValueError(f"horizon is {horizon}; expected a whole number of steps, 1 or more")
        N = int(horizon)
        targets = target_sequence(target, N, n)
        history = check_history(model, history)
        weights = LqrWeights.parse(Q, R, n, p)
        given = list(known_channels(known, N, p))
        end = terminal_weight(*_decided(model, weights, given), Qf)
        return cls(model, history, targets, N, weights, end)

    @property
    def last_state(self) -> Array:
        """x_f (hn,), rest on the last target."""
        return np.concatenate([self.targets[-1]] * self.model.history)


def target_sequence(target: ArrayLike, horizon: int, code_size: int) -> Array:
    """Targets (N, n) of one code (n,) or of a sequence (K, n), which repeats its last if short."""
    targets = np.asarray(target, dtype=np.float64)
    rows = np.atleast_2d(targets)
    if targets.ndim not in (1, 2) or rows.shape[1] != code_size or not len(rows):
        raise ValueError(
            f"target has shape {targets.shape}; expected ({code_size},), a code, or (K,"
            f" {code_size}), one code a step"
        )
    if not np.isfinite(targets).all():
        raise ValueError("target has NaN or infinity; expected finite numbers")
    return rows[np.minimum(np.arange(horizon), len(rows) - 1)]


def _decided(
    model: LinearModel, weights: LqrWeights, given: list[int]
) -> tuple[LinearModel, LqrWeights]:
    """Model and weights of the controls that are decided: only they can go on for ever."""
    if not given:
        return model, weights
    B, R = np.delete(model.B, given, 1), np.delete(np.delete(weights.R, given, 0), given, 1)
    return LinearModel(model.A, B, model.c), LqrWeights(weights.Q, R)
