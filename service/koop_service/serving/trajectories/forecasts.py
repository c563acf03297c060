"""Codes that a model expects, or why it cannot say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from koop_protocol import ErrorCode, ProtocolError
from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import rollout

Array = NDArray[np.float64]


def forecast(model: LinearModel, history: Array, controls: Array) -> Array:
    """Codes (H, n) after `history` (h, n) under controls (H, p); ProtocolError on overflow."""
    return finite(rollout(model, history, controls))


def finite(codes: Array) -> Array:
    """The codes, or ProtocolError (bad_horizon) where an unstable model let them overflow."""
    if not np.isfinite(codes).all():
        raise ProtocolError(
            ErrorCode.bad_horizon,
            f"the present model is unstable: over {len(codes)} steps its prediction overflows",
            "a prediction of finite numbers",
            "ask for a shorter horizon, or let the model see more frames",
        )
    return codes
