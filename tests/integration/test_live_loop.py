"""The service over real Zenoh: streams in, answers out."""

from __future__ import annotations

import numpy as np
import pytest
from integration.loopback import *

from koop_protocol import ErrorCode, LqrReply


def test_a_prediction_is_answered_by_selector_alone(koop: Loop, cart: Source) -> None:
    reply = koop.ask_one("koop/predict/cart/0?horizon=7;return=codes,frames,std")
    assert isinstance(reply, PredictReply)
    assert (reply.trajectory, reply.epoch, reply.seq) == ("cart/0", cart.epoch, 39)
    assert reply.codes.shape == reply.std.shape == (7, 8)
    assert reply.frames.shape == (7, 64, 64)
    assert reply.frames.dtype == np.uint8
