"""Building messages that must be refused."""

from __future__ import annotations

import numpy as np
import pytest

from koop_protocol import ProtocolError

EPOCH = "0123456789abcdef"
WHERE = {"trajectory": "cartpole/0", "epoch": EPOCH, "seq": 7}
IMAGE = np.zeros((4, 4), np.uint8)


def with_nan(*shape: int, dtype: type = np.float64) -> np.ndarray:
    array = np.zeros(shape, dtype)
    array[(-1,) * len(shape)] = np.nan
    return array


def refused(type_: type, valid: dict, **changes: object) -> ProtocolError:
    type_(**valid)
    with pytest.raises(ProtocolError) as caught:
        type_(**{**valid, **changes})
    return caught.value
