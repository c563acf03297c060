"""Bad inputs from good ones: bytes changed anywhere, and msgpack trees changed in their parts.

Bytes changed at random mostly give what is no msgpack at all. So half of the mutants are taken
apart, changed where something stands (a value, a type, a key, an array's shape), and packed again.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from random import Random
from typing import Any

import msgpack

#: What tends to lie at the edge of something.
VALUES: tuple[Any, ...] = (
    *(None, True, False, "", b"", [], {}, "codes", "riccati", "gain", "frames"),
    *(0, 1, -1, 2, 64, 65, 127, 128, 200, 255, 256, 1000, 1001, 4096, 2**31, 2**32 - 1),
    *(2**53 - 1, 2**53, 2**63 - 1, 2**63, 2**64 - 1, -(2**31), -(2**63)),
    *(0.0, -0.0, 0.5, 1.0, 1e-320, 1e308, math.inf, -math.inf, math.nan),
    *("cartpole/0", "a//b", "@a", "*", "**", "$*", "a" * 201, "é", "\ud800", "0" * 16, "f" * 16),
    *("u1", "f2", "f4", "f8", "i4", "O", [1], [2, 2], [0], [1] * 5, [2**40, 2**40], [-1, -1]),
    *(bytes(1), bytes(8), b"\xff" * 8, bytes(64), "x" * 4097, list(range(65))),
    *({"dtype": "f8", "shape": [1], "data": bytes(8)}, {"dtype": "u1", "shape": [2, 2]}),
)  # fmt: skip


def mutated(data: bytes, random: Random, most: int = 1 << 16) -> bytes:
    """Another input of at most `most` bytes, some of its parts those of `data`."""
    for _ in range(random.choice((1, 1, 1, 2, 3, 5))):
        change = _changed_tree if random.random() < 0.6 else _changed_bytes
        data = change(data, random)
    return data[:most]


def spliced(one: bytes, other: bytes, random: Random) -> bytes:
    """The beginning of one input and the end of another."""
    return one[: random.randint(0, len(one))] + other[random.randint(0, len(other)) :]


# Bytes


def _changed_bytes(data: bytes, random: Random) -> bytes:
    return random.choice(_BYTE_CHANGES)(bytearray(data), random)


def _set_bytes(data: bytearray, random: Random) -> bytes:
    for _ in range(random.choice((1, 1, 2, 4))):
        if data:
            data[random.randrange(len(data))] = random.randrange(256)
    return bytes(data)


def _flip_bit(data: bytearray, random: Random) -> bytes:
    if data:
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)
    return bytes(data)


def _cut(data: bytearray, random: Random) -> bytes:
    return bytes(data[: random.randint(0, len(data))])


def _drop(data: bytearray, random: Random) -> bytes:
    at = random.randint(0, len(data))
    del data[at : at + random.choice((1, 2, 4, 8, 64))]
    return bytes(data)


def _insert(data: bytearray, random: Random) -> bytes:
    at = random.randint(0, len(data))
    data[at:at] = random.randbytes(random.choice((1, 2, 4, 8, 64)))
    return bytes(data)


def _repeat(data: bytearray, random: Random) -> bytes:
    at, size = random.randint(0, len(data)), random.choice((1, 2, 8, 32))
    data[at:at] = data[at : at + size] * random.choice((1, 2, 40))
    return bytes(data)


def _announce(data: bytearray, random: Random) -> bytes:
    """A msgpack header that promises far more than follows."""
    at, size = random.randint(0, len(data)), random.choice((65, 4097, 2**16, 2**31, 2**32 - 1))
    data[at : at + 1] = random.choice((b"\xdd", b"\xdf", b"\xc6", b"\xdb", b"\xc9"))
    data[at + 1 : at + 1] = struct.pack(">I", size)
    return bytes(data)


_BYTE_CHANGES: tuple[Callable[[bytearray, Random], bytes], ...] = (
    *(_set_bytes, _flip_bit, _cut, _drop, _insert, _repeat, _announce),
)  # fmt: skip


# Trees


def _changed_tree(data: bytes, random: Random) -> bytes:
    try:
        tree = msgpack.unpackb(data, strict_map_key=False)
        places = _places(tree)
        _change(*random.choice(places), random)
        return msgpack.packb(tree, unicode_errors="surrogatepass")
    except Exception:  # whatever msgpack makes of bytes that were spoilt before
        return _changed_bytes(data, random)


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """(container, key or index) of every entry; an array's own three less often than others."""
    if isinstance(tree, dict):
        own = [(tree, key) for key in tree]
        return own + [place for value in tree.values() for place in _places(value)]
    if isinstance(tree, list):
        own = [(tree, index) for index in range(len(tree))]
        return own + [place for value in tree for place in _places(value)]
    return []


def _change(container: Any, at: Any, random: Random) -> None:
    value, chance = container[at], random.random()
    if chance < 0.2:
        container[at] = random.choice(VALUES)
    elif chance < 0.3:
        del container[at]
    elif chance < 0.4 and isinstance(container, dict):
        container[random.choice((at, "later", "", 7, "limits"))] = random.choice(VALUES)
    elif chance < 0.5 and isinstance(value, dict) and "shape" in value:
        _reshape(value, random)
    else:
        container[at] = _near(value, random)


def _near(value: Any, random: Random) -> Any:
    """A value of the same type, or one that is easily taken for it."""
    if isinstance(value, bool):
        return random.choice((not value, int(value)))
    if isinstance(value, int):
        return random.choice((value + 1, value - 1, -value, float(value), str(value), 2 * value))
    if isinstance(value, float):
        return random.choice((-value, value * 1e300, value / 1e300, int(value), value + 1.0))
    if isinstance(value, str):
        return random.choice((value + "x", value[:-1], value.upper(), value * 3, value.encode()))
    if isinstance(value, bytes):
        return random.choice((value[:-1], value + b"\0", random.randbytes(len(value)), value * 2))
    if isinstance(value, list):
        return random.choice((value[::-1], value * 2, value[:-1], [value], tuple(value)))
    return random.choice((value, [value], {"": value}))


def _reshape(array: dict[Any, Any], random: Random) -> None:
    """Other sizes or another type, and mostly the data that belong to them."""
    shape = [random.choice((1, 1, 2, 3, 8, 65)) for _ in range(random.randint(1, 5))]
    name = random.choice(("u1", "f2", "f4", "f8"))
    size = math.prod(shape) * int(name[1])
    if size <= 1 << 14:
        array["data"] = random.choice((bytes(size), random.randbytes(size), b"\x3f" * size))
    array["shape"], array["dtype"] = shape, name
