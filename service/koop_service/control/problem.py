"""Eq. 13 as a condensed quadratic programme: everything a caller may ask for, checked and built."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_service.prediction.model import LinearModel

from .bounds import ControlBounds
from .condense import CondensedQP, condense
from .objective import LqrProblem

__all__ = ["CondensedQP", "build_lqr"]

Array = NDArray[np.float64]


def build_lqr(
    model: LinearModel,
    history: Array,
    target: ArrayLike,
    horizon: int,
    Q: ArrayLike,
    R: ArrayLike,
    u_min: ArrayLike | None = None,
    u_max: ArrayLike | None = None,
    *,
    Qf: ArrayLike | Literal["riccati"] | None = None,
    du_min: ArrayLike | None = None,
    du_max: ArrayLike | None = None,
    last_control: ArrayLike | None = None,
    known: Mapping[int, ArrayLike] | None = None,
) -> CondensedQP:
    """Condense eq. 13 from `history` (h, n), oldest first, over `horizon` N; see `objective.py`.

    target: (n,), a code to reach and rest at; or (K, n), the code to be on at each step from 1,
    the last one repeated where K < N.
    Q (n, n) positive semidefinite and R (p, p) positive definite: each a number (times the
    identity), a vector (diagonal) or a matrix. Qf: the end's weight, see `terminal_weight`; None
    is the paper's eq. 13, "riccati" what going on for ever costs.
    u_min, u_max: a number or (p,), in the controls' unit, infinite or None where unbounded.
    du_min <= 0 <= du_max: the same for the change from one step to the next. last_control: (p,),
    the control that acts now; without it the first change is free.
    known: control channels that are given, not decided (a measured wind, a load's schedule): the
    channel to its future values, (N,) or fewer, of which the last stays. Previewed as controls,
    since their effect on a code is then learned with B; nobody could say a disturbance in code
    units. They are not bounded, and what R charges for them is in the cost.
    Raises ValueError for anything else, and where bounds and last control contradict.
    """
    problem = LqrProblem.parse(model, history, target, horizon, Q, R, Qf, known)
    bounds = ControlBounds.parse(
        problem.horizon, model.control_size, u_min, u_max, du_min, du_max, last_control, known
    )
    return condense(problem, bounds)
