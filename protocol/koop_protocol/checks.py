"""Checks of single fields: each returns the value in its canonical type or raises ProtocolError.

They take ``object``, because what a field holds may have come off the network. Sizes are looked
at before values, so that nothing expensive runs on something too large.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Collection
from typing import cast

import numpy as np
from numpy.typing import NDArray

from koop_protocol.errors import ErrorCode, ProtocolError
from koop_protocol.limits import MAX_ENTRIES, MAX_SEQUENCE

Floats = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.float16] | NDArray[np.float32]

_EPOCH = re.compile(r"[0-9a-f]{16}", re.ASCII)
_UINT8 = np.dtype(np.uint8)
_IMAGE_DTYPES = frozenset({_UINT8, np.dtype(np.float16), np.dtype(np.float32)})
_FLOAT_DTYPES = frozenset({np.dtype(np.float32), np.dtype(np.float64)})


def fault(
    code: ErrorCode, field: str, problem: str, expected: str, remedy: str = ""
) -> ProtocolError:
    """A ProtocolError about one field, whose name opens the sentence and stands in the details."""
    return ProtocolError(code, f"{field} {problem}", expected, remedy, {"field": field})


def integer(field: str, value: object, low: int, high: int) -> int:
    """An int in [low, high]; numpy integers are taken, bool and float are not."""
    if type(value) is not int:
        if not isinstance(value, int | np.integer) or isinstance(value, bool):
            raise fault(
                ErrorCode.wrong_type, field, f"is {shown(value)}", "an integer", "send it as one"
            )
        value = int(cast(int, value))
    if value > high:
        raise fault(ErrorCode.too_large, field, f"is {value}", f"at most {high}")
    if value < low:
        raise fault(ErrorCode.malformed, field, f"is {value}", f"at least {low}")
    return value


def sequence(field: str, value: object) -> int:
    """A sequence number: an int in [0, 2^53 - 1]."""
    return integer(field, value, 0, MAX_SEQUENCE)


def real(field: str, value: object, low: float = -math.inf) -> float:
    """A finite float of at least ``low``; an int is taken for one, bool is not."""
    if type(value) is not float:
        if not isinstance(value, float | int | np.floating | np.integer) or isinstance(value, bool):
            raise fault(ErrorCode.wrong_type, field, f"is {shown(value)}", "a number")
        value = _to_float(field, cast(object, value))
    if not math.isfinite(value):
        raise fault(ErrorCode.not_finite, field, f"is {value}", "a finite number")
    if value < low:
        raise fault(ErrorCode.malformed, field, f"is {value}", f"at least {low}")
    return value


def _to_float(field: str, value: object) -> float:
    try:
        return float(cast(float, value))
    except OverflowError:
        raise fault(
            ErrorCode.not_finite, field, "is an integer beyond every float", "a finite number"
        ) from None


def flag(field: str, value: object) -> bool:
    """A bool, and nothing that merely looks like one."""
    if not isinstance(value, bool):
        raise fault(ErrorCode.wrong_type, field, f"is {shown(value)}", "true or false")
    return value


def text(field: str, value: object, max_bytes: int) -> str:
    """A string of at most ``max_bytes`` bytes of UTF-8."""
    if not isinstance(value, str):
        raise fault(ErrorCode.wrong_type, field, f"is {shown(value)}", "a string")
    size = len(value) if value.isascii() else _utf8_size(field, value)
    if size > max_bytes:
        raise fault(ErrorCode.too_large, field, f"has {size} bytes", f"at most {max_bytes}")
    return value


def _utf8_size(field: str, value: str) -> int:
    try:
        return len(value.encode())
    except UnicodeEncodeError:
        raise fault(
            ErrorCode.malformed, field, "holds a lone surrogate", "text that UTF-8 can encode"
        ) from None


def epoch(field: str, value: object) -> str:
    """An epoch: 16 lower-case hex digits, drawn at random when a source starts."""
    if not isinstance(value, str):
        raise fault(ErrorCode.wrong_type, field, f"is {shown(value)}", "a string")
    if _EPOCH.fullmatch(value) is None:
        raise fault(
            ErrorCode.malformed,
            field,
            f"is {shown(value)}",
            "16 lower-case hex digits",
            "draw 8 random bytes when the source starts and send them in hex",
        )
    return value


def choices(field: str, value: object, allowed: frozenset[str]) -> frozenset[str]:
    """A set of words out of ``allowed``."""
    if not isinstance(value, frozenset | set):
        raise fault(ErrorCode.wrong_type, field, f"is {shown(value)}", "a set of words")
    words = cast("frozenset[object]", value)
    unknown = [word for word in words if word not in allowed]
    if unknown:
        raise fault(
            ErrorCode.malformed,
            field,
            f"holds {shown(unknown[0])}",
            f"any of {', '.join(sorted(allowed))}",
        )
    return frozenset(cast("frozenset[str]", words))


def word(field: str, value: object, allowed: Collection[str]) -> str:
    """One word out of ``allowed``."""
    if not isinstance(value, str):
        raise fault(ErrorCode.wrong_type, field, f"is {shown(value)}", "a word")
    if value not in allowed:
        expected = f"one of {', '.join(sorted(allowed))}"
        raise fault(ErrorCode.malformed, field, f"is {shown(value)}", expected)
    return value


def texts(field: str, value: object, max_bytes: int) -> tuple[str, ...]:
    """Strings, each as in ``text``."""
    return tuple(text(field, entry, max_bytes) for entry in _entries(field, value))


def integers(field: str, value: object, low: int, high: int) -> tuple[int, ...]:
    """Ints, each as in ``integer``; a vector of numpy integers is taken too."""
    return tuple(integer(field, entry, low, high) for entry in _entries(field, value))


def binaries(field: str, value: object) -> tuple[bytes, ...]:
    """Byte strings, none of them empty."""
    entries = _entries(field, value)
    for entry in entries:
        if not isinstance(entry, bytes):
            raise fault(
                ErrorCode.wrong_type, field, f"holds {shown(entry)}", "msgpack's bin type only"
            )
        if not entry:
            raise fault(ErrorCode.malformed, field, "holds no bytes at all", "encoded messages")
    return cast("tuple[bytes, ...]", entries)


def _entries(field: str, value: object) -> tuple[object, ...]:
    if isinstance(value, np.ndarray):
        array = cast("NDArray[np.generic]", value)
        value = list(array) if array.ndim == 1 else None
    if not isinstance(value, list | tuple):
        raise fault(ErrorCode.wrong_type, field, f"is {shown(value)}", "a list")
    entries = tuple(cast("list[object]", value))
    _fits(field, len(entries), MAX_ENTRIES, "entries")
    return entries


def image(field: str, value: object, max_values: int) -> Image:
    """An image (H, W) or (C, H, W) of at most ``max_values``; uint8, or finite float16 or 32."""
    array = _array(field, value)
    if array.ndim not in (2, 3) or not array.size:
        raise _wrong_shape(field, array, "(H, W) or (C, H, W)")
    return _image_values(field, array, array.size, max_values)


def images(field: str, value: object, max_rows: int, max_values: int) -> Image:
    """Images (N, H, W) or (N, C, H, W), at most ``max_rows`` of them; each as in ``image``."""
    array = _array(field, value)
    if array.ndim not in (3, 4) or not array.size:
        raise _wrong_shape(field, array, "(N, H, W) or (N, C, H, W)")
    _fits(field, array.shape[0], max_rows, "rows")
    return _image_values(field, array, array.size // array.shape[0], max_values)


def image_or_images(field: str, value: object, max_rows: int, max_values: int) -> Image:
    """One image or several: three axes may be channels or rows, which only its reader can tell."""
    if _array(field, value).ndim == 2:
        return image(field, value, max_values)
    return images(field, value, max_rows, max_values)


def vector(field: str, value: object, max_size: int) -> Floats:
    """A finite vector (size,) with 1 <= size <= max_size, as float64."""
    array = _array(field, value)
    if array.ndim != 1 or not array.size:
        raise _wrong_shape(field, array, "(size,)")
    _fits(field, array.size, max_size, "components")
    return np.asarray(_float_values(field, array), np.float64)


def table(field: str, value: object, max_rows: int, max_columns: int) -> NDArray[np.floating]:
    """A finite matrix (rows, columns), float32 or float64 as it came."""
    array = _array(field, value)
    if array.ndim != 2 or not array.size:
        raise _wrong_shape(field, array, "(rows, columns)")
    _fits(field, array.shape[0], max_rows, "rows")
    _fits(field, array.shape[1], max_columns, "columns")
    return _float_values(field, array)


def vector_or_table(field: str, value: object, max_rows: int, max_size: int) -> Floats:
    """A finite vector (size,) or several in rows (rows, size), as float64."""
    if _array(field, value).ndim == 1:
        return vector(field, value, max_size)
    return np.asarray(table(field, value, max_rows, max_size), np.float64)


def _fits(field: str, size: int, limit: int, unit: str) -> None:
    if size > limit:
        raise fault(ErrorCode.too_large, field, f"has {size} {unit}", f"at most {limit}")


def _image_values(field: str, array: NDArray[np.generic], size: int, max_values: int) -> Image:
    _fits(field, size, max_values, "values an image")
    if array.dtype not in _IMAGE_DTYPES:
        raise _wrong_dtype(field, array, "uint8, float16 or float32")
    if array.dtype != _UINT8:
        _finite(field, array)
    return cast(Image, array)


def _float_values(field: str, array: NDArray[np.generic]) -> NDArray[np.floating]:
    if array.dtype not in _FLOAT_DTYPES:
        raise _wrong_dtype(field, array, "float32 or float64")
    return _finite(field, array)


def _array(field: str, value: object) -> NDArray[np.generic]:
    if not isinstance(value, np.ndarray):
        raise fault(ErrorCode.wrong_type, field, f"is {shown(value)}", "an array")
    return cast("NDArray[np.generic]", value)


def _finite(field: str, array: NDArray[np.generic]) -> NDArray[np.floating]:
    floats = cast("NDArray[np.floating]", array)
    if not np.isfinite(floats).all():
        raise fault(ErrorCode.not_finite, field, "holds NaN or infinity", "finite values only")
    return floats


def _wrong_shape(field: str, array: NDArray[np.generic], expected: str) -> ProtocolError:
    return fault(ErrorCode.wrong_shape, field, f"has shape {array.shape}", f"{expected}, not empty")


def _wrong_dtype(field: str, array: NDArray[np.generic], allowed: str) -> ProtocolError:
    return fault(
        ErrorCode.wrong_dtype,
        field,
        f"has dtype {array.dtype}",
        allowed,
        "convert it before sending",
    )


def shown(value: object) -> str:
    """A value's type and a shortened form of it, for an error's text."""
    if isinstance(value, bytes):
        return f"{len(value)} bytes"  # their repr could be many times the message
    if isinstance(value, np.ndarray):
        return f"an array of shape {cast('NDArray[np.generic]', value).shape}"
    return f"{reprlib.repr(value)} ({type(value).__name__})"
