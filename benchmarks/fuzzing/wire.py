"""Every decoder of bytes from the network, as a function of bytes that must not break.

A target takes any bytes. It returns whether they meant something, and raises nothing: what the
decoder says of bad bytes is its one typed error, and what it takes means the same after another
round. Anything else that comes out of it is a finding.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh
from fuzzing.guard import Target

from koop_protocol import (
    ErrorCode,
    ErrorReply,
    KoopKey,
    Limits,
    LqrQuery,
    Message,
    ProtocolError,
    check_trajectory,
    client_token,
    decode,
    encode,
    keys,
    owner_of,
    parse_key,
    predict_query_from_parameters,
    source_token,
    trajectory_of,
)
from koop_protocol.arrays import array_from_map, array_to_map
from koop_protocol.limits import DEFAULT_LIMITS

TIGHT = Limits(
    max_message_bytes=2048,
    max_image_values=16,
    max_code_size=4,
    max_control_size=2,
    max_horizon=8,
    max_name_length=16,
)
"""A receiver that takes little: its limits are within reach of a short message."""


def message(data: bytes) -> bool:
    """A message of any type, for a receiver that takes much and for one that takes little."""
    found, tight = _decoded(data, DEFAULT_LIMITS), _decoded(data, TIGHT)
    if found is None:
        assert tight is None, "a tighter limit let something through"
        return False
    _check_round(found, len(data))
    if tight is not None:
        assert same(found, tight), "the message depends on the limits"
    return True


def array(data: bytes) -> bool:
    """An array's map, alone."""
    try:
        value = msgpack.unpackb(data, strict_map_key=False)
    except Exception:  # the codec's own unpacking is what `message` looks at
        return False
    if not isinstance(value, dict):
        return False
    try:
        found = array_from_map("x", value)
    except ProtocolError as error:
        _check_refusal(error)
        return False
    again = array_to_map("x", found)
    assert again["data"] == value["data"], "an array's bytes changed"
    assert list(again["shape"]) == value["shape"]
    assert again["dtype"] == value["dtype"]
    return True


_CODES = frozenset(ErrorCode)
_BUILDERS: dict[str, Callable[[str], str]] = {
    kind.value: getattr(keys, f"{kind.value}_key")
    for kind in keys.KeyKind
    if kind is not keys.KeyKind.health  # whose key names no trajectory
}


def key(data: bytes) -> bool:
    """A key, a trajectory's name, and the tokens of owners and sources, as text."""
    text = data.decode(errors="surrogateescape")
    name = _allowed(check_trajectory, text)
    assert name is None or all(build(name) for build in _BUILDERS.values())
    owner = _allowed(owner_of, text)
    assert owner is None or client_token(owner) == text
    source = _allowed(trajectory_of, text)
    assert source is None or source_token(source) == text
    parsed: KoopKey | None = _allowed(parse_key, text)
    if parsed is not None:
        assert _BUILDERS[parsed.kind](parsed.trajectory) == text, "a key has two spellings"
    return any(part is not None for part in (name, owner, source, parsed))


def selector(data: bytes) -> bool:
    """A selector's parameters, taken apart by Zenoh as a query's are."""
    parameters = dict(zenoh.Parameters(data.decode(errors="replace")))
    query = _allowed(predict_query_from_parameters, parameters)
    if query is None:
        return False
    _check_round(query, len(data))
    return True


TARGETS: dict[str, Target] = {
    "message": message,
    "array": array,
    "key": key,
    "selector": selector,
}


def same(one: Message, other: Message) -> bool:
    """Equal in type and in every field, arrays bit for bit."""
    return type(one) is type(other) and all(
        _same_value(getattr(one, field.name), getattr(other, field.name)) for field in fields(one)
    )


def _same_value(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        kind = (one.dtype, one.shape) == (other.dtype, other.shape)
        return kind and one.tobytes() == other.tobytes()
    return same(one, other) if isinstance(one, LqrQuery) else one == other


def _decoded(data: bytes, limits: Limits) -> Message | None:
    return _allowed(lambda: decode(data, limits))


def _allowed(function: Callable[..., Any], *arguments: Any) -> Any:
    """What the decoder returns, or None where it refuses as it may."""
    try:
        return function(*arguments)
    except ProtocolError as error:
        _check_refusal(error)
        return None


def _check_refusal(error: ProtocolError) -> None:
    """It must be fit to be sent back to whoever caused it."""
    assert error.code in _CODES, error.code
    assert encode(ErrorReply.from_error(error))


def _check_round(found: Message, size: int) -> None:
    """Decoding what was encoded again gives the same message."""
    try:
        data = encode(found)
    except ProtocolError as error:
        # Numbers grow: what came as an integer of one byte is sent as a float of eight.
        if error.code == ErrorCode.too_large and 9 * size > DEFAULT_LIMITS.max_message_bytes:
            return
        raise AssertionError("a message that was taken cannot be sent") from error
    again = decode(data)
    assert same(again, found), "a message changed on its way"
    assert encode(again) == data, "the same message has two encodings"


# Where mutation begins

_GOLDEN = Path(__file__).parents[2] / "tests" / "protocol" / "golden" / "messages.json"


def messages() -> list[bytes]:
    """Every message of the protocol, as it has always been sent."""
    lines: dict[str, str] = json.loads(_GOLDEN.read_text(encoding="utf-8"))
    return [bytes.fromhex(line) for line in lines.values()]


def arrays() -> list[bytes]:
    """The arrays in those messages, by their maps."""
    parts = [value for data in messages() for value in msgpack.unpackb(data).values()]
    return [msgpack.packb(part) for part in parts if isinstance(part, dict) and "data" in part]


def texts() -> list[bytes]:
    """Keys of every kind, tokens, and names."""
    return [
        *(b"koop/frame/1b/cartpole/0", b"koop/control/26/line3/robot7", b"koop/state/pendulum"),
        *(b"koop/predict/cartpole/0", b"koop/lqr/line3/robot7", b"koop/command/cartpole/0"),
        *(b"koop/replay/20/pendulum", b"koop/@client/0123456789abcdef", b"koop/@client/a_b.c-d"),
        *(b"koop/@source/1b/cartpole/0", b"koop/durable/26/line3/robot7"),
        *(b"cartpole/0", b"line3/robot7/left.arm"),
    ]


def selectors() -> list[bytes]:
    """Parameters of predictions."""
    return [
        *(b"", b"horizon=20", b"horizon=7;return=codes,frames,std", b"return=codes"),
        *(b"_time=now;horizon=3", b"horizon=1000;_anyke"),
    ]


SEEDS: dict[str, Callable[[], list[bytes]]] = {
    "message": messages,
    "array": arrays,
    "key": texts,
    "selector": selectors,
}
