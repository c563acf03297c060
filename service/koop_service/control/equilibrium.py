"""Whether a target can be held: eq. 13 asks the codes to stay at z_f; a model may not allow it."""

import numpy as np
from numpy.typing import NDArray

from koop_service.prediction.model import LinearModel

Array = NDArray[np.float64]


def resting_control(model: LinearModel, target: Array) -> tuple[Array, Array]:
    """The constant control (p,) that best holds `target` (n,), and the drift (n,) that is left.

    The drift is the next code less the target when the whole history is the target: zero where the
    target is an equilibrium of the model. It bounds what `build_lqr` can reach from below.
    """
    still = np.tile(target, model.history)
    drift = model.A @ still + model.c - target
    u = np.asarray(np.linalg.lstsq(model.B, -drift, rcond=None)[0], dtype=np.float64)
    return u, drift + model.B @ u
