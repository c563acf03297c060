"""Plans in time: what is left of one, and where the system will be when a new one begins."""

import numpy as np
from numpy.typing import NDArray

from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import check_history, rollout

Array = NDArray[np.float64]


def rest_of_plan(plan: Array, elapsed: int) -> Array:
    """`plan` (N, p) as it stands `elapsed` steps later, (N, p): the rest, then its last row held.

    Its first row is what to apply when no new command has come for `elapsed` steps.
    Raises ValueError for a plan without rows and for elapsed < 0.
    """
    if plan.ndim != 2 or not len(plan):
        raise ValueError(f"plan has shape {plan.shape}; expected (N, p), N >= 1")
    if elapsed < 0:
        raise ValueError(f"elapsed is {elapsed}; expected steps since the plan began, 0 or more")
    N = len(plan)
    return plan[np.minimum(np.arange(N) + elapsed, N - 1)]


def roll_forward(model: LinearModel, history: Array, committed: Array) -> Array:
    """The history (h, n) after the controls `committed` (D, p) have acted: where a plan can begin.

    history: (h, n) measured codes, oldest first. committed: what will act before the plan's first
    control can, oldest first; D is the delay from frame to actuation in steps, 0 for none. For rate
    bounds the last control is then committed[-1].
    """
    history = check_history(model, history)
    if not len(committed):
        return history
    codes = rollout(model, history, committed)
    return np.concatenate([history, codes])[-len(history) :]
