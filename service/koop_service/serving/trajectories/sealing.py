"""A record as bytes that prove themselves: a digest, then msgpack with its arrays inside.

Stores and disks may damage what they keep. A record that does not match its digest is never used.
"""

from __future__ import annotations

import hashlib
from typing import Any, cast

import msgpack
import numpy as np

_DIGEST = 16  # bytes


def seal(record: dict[str, Any]) -> bytes:
    """The record, of plain values and arrays, as bytes."""
    body = cast(bytes, msgpack.packb(record, default=_array_to_map))
    return _digest(body) + body


def unseal(sealed: bytes) -> dict[str, Any]:
    """The record that `seal` was given. Raises ValueError where the bytes are damaged."""
    body = sealed[_DIGEST:]
    if not is_whole(sealed):
        raise ValueError("it is damaged: its digest does not fit")
    return msgpack.unpackb(body, object_hook=_array_from_map, strict_map_key=False)


def is_whole(sealed: bytes) -> bool:
    """Whether the digest fits."""
    return sealed[:_DIGEST] == _digest(sealed[_DIGEST:])


def _digest(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_DIGEST).digest()


def _array_to_map(value: object) -> object:
    if isinstance(value, np.ndarray):
        return {"": value.dtype.str, "shape": value.shape, "data": value.tobytes()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _array_from_map(value: dict[Any, Any]) -> object:
    if "" not in value:
        return value
    return np.frombuffer(value["data"], np.dtype(value[""])).reshape(value["shape"]).copy()
