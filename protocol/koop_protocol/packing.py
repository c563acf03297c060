"""msgpack maps in and out: the only place that knows the msgpack library.

Everything here is bounded before it is built: msgpack refuses a declared length beyond its limits
when it reads the header, and the hooks below count maps and lists, so that a small message cannot
unfold into a large heap of tiny objects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import msgpack  # pyright: ignore[reportMissingTypeStubs]

from koop_protocol.errors import ErrorCode, ProtocolError
from koop_protocol.limits import MAX_ENTRIES, MAX_TEXT_BYTES, Limits

MAX_CONTAINERS = 64
"""Most maps and lists in one message; the largest message of version 1 has 26."""

Buffer = bytes | bytearray | memoryview

# msgpack carries no types; these are its two functions as used here.
_packb = cast(Callable[..., bytes], msgpack.packb)  # pyright: ignore[reportUnknownMemberType]
_unpackb = cast(Callable[..., object], msgpack.unpackb)  # pyright: ignore[reportUnknownMemberType]
_UnpackError = cast(type[Exception], msgpack.UnpackException)


def pack_map(fields: dict[str, Any]) -> bytes:
    """The map in msgpack: str as str, bytes as bin, every float in 64 bits."""
    return _packb(fields, use_bin_type=True)


def unpack_map(data: Buffer, limits: Limits) -> dict[str, object]:
    """The one map that ``data`` holds.

    Raises:
        ProtocolError: too_large or malformed.
    """
    _check_size(len(data) if isinstance(data, bytes) else memoryview(data).nbytes, limits)
    value = _unpack(data, limits)
    if not isinstance(value, dict):
        raise ProtocolError(
            ErrorCode.malformed,
            f"the message is a {type(value).__name__}",
            "a msgpack map",
            "see docs/wire.md",
        )
    return cast("dict[str, object]", value)


def _unpack(data: Buffer, limits: Limits) -> object:
    containers = 0

    def count() -> None:
        nonlocal containers
        containers += 1
        if containers > MAX_CONTAINERS:
            raise ProtocolError(
                ErrorCode.too_large,
                "the message holds too many maps and lists",
                f"at most {MAX_CONTAINERS}",
            )

    def take_list(items: list[object]) -> list[object]:
        count()
        return items

    def take_map(pairs: list[tuple[object, object]]) -> dict[object, object]:
        count()
        entries = dict(pairs)
        if len(entries) != len(pairs):
            raise ProtocolError(
                ErrorCode.malformed, "a map holds the same key twice", "every key once"
            )
        return entries

    try:
        return _unpackb(
            data,
            object_pairs_hook=take_map,
            list_hook=take_list,
            max_bin_len=limits.max_message_bytes,
            max_str_len=MAX_TEXT_BYTES,
            max_array_len=MAX_ENTRIES,
            max_map_len=MAX_ENTRIES,
            max_ext_len=0,
        )
    except ProtocolError:
        raise
    except (_UnpackError, ValueError, TypeError, OverflowError) as error:
        raise _unreadable(error) from error


def check_packed_size(data: bytes, limits: Limits) -> bytes:
    """``data`` if it may be sent, else ProtocolError (too_large)."""
    _check_size(len(data), limits)
    return data


def _check_size(size: int, limits: Limits) -> None:
    if size > limits.max_message_bytes:
        raise ProtocolError(
            ErrorCode.too_large,
            f"the message has {size} bytes",
            f"at most {limits.max_message_bytes}",
            "ask for or send less at once, or let the receiver take more: koop-serve's "
            "--max-message-bytes",
            {"limit": limits.max_message_bytes},
        )


def _unreadable(error: Exception) -> ProtocolError:
    """msgpack's complaint as ours: a length beyond a limit is told from broken bytes."""
    reason = str(error) or type(error).__name__
    if "exceeds max_" in reason:
        return ProtocolError(
            ErrorCode.too_large,
            f"a part of the message is too large ({reason})",
            f"text of {MAX_TEXT_BYTES} bytes, lists and maps of {MAX_ENTRIES} entries at most, "
            "no extension types",
        )
    return ProtocolError(
        ErrorCode.malformed,
        f"the bytes are not msgpack ({reason})",
        "exactly one msgpack map",
        "see docs/wire.md",
    )
