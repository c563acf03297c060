"""Messages to bytes and back: the one codec of the protocol.

A message is a msgpack map ``{"v": 1, "type": "frame", ...}`` whose other keys are the fields of
its dataclass; a field that is None is left out. A query inside a message is a map of its
fields alone. A field that a later release added is left out where it has its default, so that the
bytes of messages without it stay what they were. Unknown keys are ignored, so that a later release
of the same version can add optional ones.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from typing import Any, TypeVar, cast

import numpy as np

from koop_protocol import checks
from koop_protocol.arrays import Array, array_from_map, array_to_map
from koop_protocol.errors import ErrorCode, ProtocolError
from koop_protocol.limits import DEFAULT_LIMITS, Limits
from koop_protocol.messages import (
    VERSION,
    Command,
    Control,
    Durable,
    ErrorReply,
    Frame,
    Health,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    Message,
    PredictQuery,
    PredictReply,
    ReplayQuery,
    ReplayReply,
    StateReply,
    TrajectoryEnd,
)
from koop_protocol.packing import Buffer, check_packed_size, pack_map, unpack_map

M = TypeVar(
    "M",
    Frame,
    Control,
    PredictQuery,
    PredictReply,
    LqrQuery,
    LqrReply,
    LqrTask,
    LqrCancel,
    Command,
    LqrEnd,
    StateReply,
    ReplayQuery,
    ReplayReply,
    Durable,
    Health,
    TrajectoryEnd,
    ErrorReply,
)


@dataclass(frozen=True)
class _Layout:
    """How one message type travels; made once at import."""

    name: str
    type: type[Message]
    names: tuple[str, ...]
    required: tuple[str, ...]
    arrays: frozenset[str]
    sets: frozenset[str]
    queries: frozenset[str]
    omitted: dict[str, object]


def _layout(
    name: str,
    type_: type[Message],
    arrays: str = "",
    sets: str = "",
    queries: str = "",
    added: str = "",
) -> _Layout:
    """`added`: fields of a later release; their defaults are not sent."""
    parts = fields(type_)
    required = (
        part.name for part in parts if part.default is MISSING and part.default_factory is MISSING
    )
    return _Layout(
        name,
        type_,
        tuple(part.name for part in parts),
        tuple(required),
        frozenset(arrays.split()),
        frozenset(sets.split()),
        frozenset(queries.split()),
        {part.name: part.default for part in parts if part.name in added.split()},
    )


_LAYOUTS = (
    _layout("frame", Frame, "image", added="logged"),
    _layout("control", Control, "u"),
    _layout("predict_query", PredictQuery, "controls", "returns"),
    _layout("predict_reply", PredictReply, "codes frames std"),
    _layout(
        "lqr_query",
        LqrQuery,
        "target_image target_code q r u_min u_max qf du_min du_max known_controls",
        "returns",
    ),
    _layout("lqr_reply", LqrReply, "controls codes frames modes scores information probing"),
    _layout("lqr_task", LqrTask, queries="query"),
    _layout("lqr_cancel", LqrCancel),
    _layout("command", Command, "controls"),
    _layout("lqr_end", LqrEnd),
    _layout("state", StateReply),
    _layout("replay_query", ReplayQuery),
    _layout("replay_reply", ReplayReply),
    _layout("durable", Durable),
    _layout("health", Health),
    _layout("trajectory_end", TrajectoryEnd),
    _layout("error", ErrorReply),
)
_BY_NAME = {layout.name: layout for layout in _LAYOUTS}
_BY_TYPE = {layout.type: layout for layout in _LAYOUTS}


def encode(message: Message, limits: Limits = DEFAULT_LIMITS) -> bytes:
    """The message's bytes.

    Raises:
        ProtocolError: too_large, where they exceed ``limits.max_message_bytes``.
    """
    head = {"v": VERSION, "type": _BY_TYPE[type(message)].name}
    return check_packed_size(pack_map(head | _fields_of(message)), limits)


def decode(data: Buffer, limits: Limits = DEFAULT_LIMITS) -> Message:
    """The message in ``data``; its arrays are read-only views.

    The views look at bytes that msgpack copied out once, so ``data`` may be reused afterwards.

    Raises:
        ProtocolError: for everything that can be wrong with the bytes, and nothing else.
    """
    entries = unpack_map(data, limits)
    return _build(_find_layout(entries), entries, limits)


def decode_as(type_: type[M], data: Buffer, limits: Limits = DEFAULT_LIMITS) -> M:
    """The message in ``data``, which must be of the given type; else ProtocolError (malformed)."""
    message = decode(data, limits)
    if not isinstance(message, type_):
        raise ProtocolError(
            ErrorCode.malformed,
            f"a message of type {_BY_TYPE[type(message)].name!r} came",
            f"one of type {_BY_TYPE[type_].name!r}",
            "send each message on the key that docs/wire.md names for it",
        )
    return message


def _find_layout(entries: dict[str, object]) -> _Layout:
    version = checks.integer("v", entries.get("v"), 0, 2**64)
    if version != VERSION:
        raise ProtocolError(
            ErrorCode.unsupported_version,
            f"the message is of version {version}",
            f"version {VERSION}, the only one supported here",
            "upgrade the older of the two ends",
            {"supported": VERSION, "version": min(version, 2**53 - 1)},
        )
    name = entries.get("type")
    layout = _BY_NAME.get(name) if isinstance(name, str) else None
    if layout is None:
        raise ProtocolError(
            ErrorCode.malformed,
            f"the message's type is {checks.shown(name)}",
            f"one of {', '.join(_BY_NAME)}",
            "see docs/wire.md",
        )
    return layout


def _build(layout: _Layout, entries: dict[str, object], limits: Limits) -> Message:
    """The message whose fields are among the entries."""
    found: dict[str, Any] = {}
    for name in layout.names:
        value = entries.get(name)
        if value is not None:
            found[name] = _from_wire(layout, name, value, limits)
    for name in layout.required:
        if name not in found:
            raise ProtocolError(
                ErrorCode.malformed,
                f"the {layout.name} lacks its field {name!r}",
                f"the fields {', '.join(layout.required)}",
                "see docs/wire.md",
                {"field": name},
            )
    return layout.type(**found, limits=limits)


def _fields_of(message: Message) -> dict[str, Any]:
    layout = _BY_TYPE[type(message)]
    values = {name: getattr(message, name) for name in layout.names}
    return {
        name: _to_wire(name, value)
        for name, value in values.items()
        if value is not None and value is not layout.omitted.get(name)
    }


def _to_wire(name: str, value: object) -> object:
    if isinstance(value, np.ndarray):
        return array_to_map(name, cast(Array, value))
    if isinstance(value, frozenset):
        return sorted(cast("frozenset[str]", value))
    if isinstance(value, LqrQuery):
        return _fields_of(value)
    return value


def _from_wire(layout: _Layout, name: str, value: object, limits: Limits) -> object:
    """Arrays, sets and queries out of their wire form; the rest is left to the message's checks."""
    if name in layout.arrays and isinstance(value, dict):
        return array_from_map(name, cast("dict[str, object]", value))
    if name in layout.sets and isinstance(value, list):
        return _word_set(name, cast("list[object]", value))
    if name in layout.queries and isinstance(value, dict):
        return _build(_BY_TYPE[LqrQuery], cast("dict[str, object]", value), limits)
    return value


def _word_set(name: str, value: list[object]) -> frozenset[str]:
    words = [word for word in value if isinstance(word, str)]
    if len(words) != len(value):
        raise checks.fault(ErrorCode.wrong_type, name, "holds something else", "words only")
    return frozenset(words)
