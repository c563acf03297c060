"""Arrays on the wire: {"dtype": "u1", "shape": [64, 64], "data": bin}, little-endian, C order."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from koop_protocol import checks
from koop_protocol.errors import ErrorCode

Array = NDArray[np.generic]

MAX_DIMENSIONS = 4

_DTYPES = {name: np.dtype(f"<{name}") for name in ("u1", "f2", "f4", "f8")}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}


def array_to_map(field: str, array: Array) -> dict[str, Any]:
    """The array as a map of plain values; copies the data once."""
    name = _NAMES.get(array.dtype)
    if name is None:
        raise checks.fault(
            ErrorCode.wrong_dtype, field, f"has dtype {array.dtype}", ", ".join(_DTYPES)
        )
    return {"dtype": name, "shape": array.shape, "data": array.tobytes()}


def array_from_map(field: str, value: dict[str, object]) -> Array:
    """A read-only view on the map's bytes; allocates nothing, whatever shape is declared.

    Raises:
        ProtocolError: wrong_dtype, wrong_shape, wrong_type.
    """
    name, data = value.get("dtype"), value.get("data")
    dtype = _DTYPES.get(name) if isinstance(name, str) else None
    if dtype is None:
        raise checks.fault(
            ErrorCode.wrong_dtype,
            field,
            f"has the dtype {checks.shown(name)}",
            f"one of {', '.join(_DTYPES)}",
        )
    if not isinstance(data, bytes):
        raise checks.fault(
            ErrorCode.wrong_type, field, f"has the data {checks.shown(data)}", "msgpack's bin type"
        )
    shape = _shape(field, value.get("shape"))
    if math.prod(shape) * dtype.itemsize != len(data):
        raise checks.fault(
            ErrorCode.wrong_shape,
            field,
            f"declares shape {shape} of {name} but has {len(data)} bytes of data",
            f"{math.prod(shape) * dtype.itemsize} bytes",
        )
    return np.frombuffer(data, dtype).reshape(shape)


def _shape(field: str, value: object) -> list[int]:
    sizes: list[object] = cast("list[object]", value) if isinstance(value, list) else []
    # bool is an int to Python, and True * 4 would pass for a size.
    if not 1 <= len(sizes) <= MAX_DIMENSIONS or not all(
        type(size) is int and size >= 1 for size in sizes
    ):
        raise checks.fault(
            ErrorCode.wrong_shape,
            field,
            f"declares the shape {checks.shown(cast(object, value))}",
            f"a list of 1 to {MAX_DIMENSIONS} integers of at least 1",
        )
    return cast("list[int]", sizes)
