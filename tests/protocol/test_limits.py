"""Limits hold before anything is allocated: peak memory stays near the size of the input."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable

import msgpack
import numpy as np
import pytest

from koop_protocol import Control, ErrorCode, Frame, Limits, ProtocolError, decode, encode

EPOCH = "0123456789abcdef"
MEGABYTE = 1_000_000


def refuse(data: bytes, limits: Limits | None = None) -> tuple[str, int]:
    """The refusal's code and the peak of memory [bytes] that refusing took."""
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError) as caught:
            decode(data, limits or Limits())
        return caught.value.code, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def frame_map(**changes: object) -> dict[str, object]:
    image = {"dtype": "u1", "shape": [2, 2], "data": bytes(4)}
    entries = {"v": 1, "type": "frame", "trajectory": "a", "epoch": EPOCH, "seq": 0}
    return {**entries, "control_size": 0, "image": image, **changes}


@pytest.mark.parametrize(
    "shape", [[10**12], [10**6, 10**6], [2**63, 2**63, 2**63], [2**64 - 1, 1], [10**12, 0]]
)
def test_a_declared_shape_without_its_data_is_refused_cheaply(shape):
    image = {"dtype": "f4", "shape": shape, "data": bytes(10)}
    code, peak = refuse(msgpack.packb(frame_map(image=image)))
    assert code == ErrorCode.wrong_shape
    assert peak < MEGABYTE


@pytest.mark.parametrize(
    "header",
    [
        b"\xdd" + struct.pack(">I", 2**32 - 1),  # a list of 4 billion
        b"\xdf" + struct.pack(">I", 2**32 - 1),  # a map of 4 billion
        b"\xc6" + struct.pack(">I", 2**32 - 1),  # 4 GB of bytes
        b"\xdb" + struct.pack(">I", 2**32 - 1),  # 4 GB of text
        b"\xc9" + struct.pack(">I", 2**32 - 1) + b"\x05",  # 4 GB of an extension
    ],
)
def test_a_declared_msgpack_length_is_refused_cheaply(header):
    code, peak = refuse(b"\x81\xa1x" + header + bytes(10))
    assert code in (ErrorCode.malformed, ErrorCode.too_large)
    assert peak < MEGABYTE


@pytest.mark.parametrize("value", ["x" * 4097, [0] * 65, {str(i): 0 for i in range(65)}])
def test_an_unknown_key_obeys_the_limits_too(value):
    assert refuse(msgpack.packb(frame_map(later=value)))[0] == ErrorCode.too_large


@pytest.mark.parametrize("opener", [b"\x91", b"\x81\xa1x", b"\xdc\x00\x40"])
def test_a_depth_bomb_is_refused_cheaply(opener):
    code, peak = refuse(opener * 1_000_000)
    assert code in (ErrorCode.malformed, ErrorCode.too_large)
    assert peak < 2 * MEGABYTE


def test_a_heap_of_tiny_containers_is_refused_cheaply():
    # 4 MB that would unfold into 240 MB of empty lists.
    row = b"\xdc\x00\x40" + b"\x90" * 64
    table = b"\xdc\x00\x40" + row * 64
    code, peak = refuse(b"\xdc\x00\x0f" + table * 15)
    assert code == ErrorCode.too_large
    assert peak < MEGABYTE


def test_an_extension_type_is_refused():
    assert refuse(msgpack.packb(msgpack.Timestamp(1)))[0] == ErrorCode.too_large
    assert refuse(msgpack.packb(msgpack.ExtType(5, b"x")))[0] == ErrorCode.too_large


def test_a_message_beyond_its_bytes_is_refused_before_it_is_read():
    code, peak = refuse(b"\xc1" * 2000, Limits(max_message_bytes=1999))
    assert code == ErrorCode.too_large
    assert peak < 100_000


def test_a_sender_meets_the_byte_limit_too():
    frame = Frame("a", EPOCH, 0, 0, np.zeros((64, 64), np.uint8))
    with pytest.raises(ProtocolError, match=r"4\d\d\d bytes; expected at most 4096") as caught:
        encode(frame, Limits(max_message_bytes=4096))
    assert caught.value.code == ErrorCode.too_large


def build(limits: Limits, size: int) -> Callable[[], object]:
    return lambda: Control("a", EPOCH, 0, np.zeros(size), limits=limits)


def test_limits_of_the_receiver_hold_at_both_ends():
    small = Limits(max_control_size=2, max_image_values=6, max_name_length=3)
    control = Control("a", EPOCH, 0, np.zeros(3))
    assert refuse(encode(control), small)[0] == ErrorCode.too_large
    with pytest.raises(ProtocolError, match="3 components; expected at most 2"):
        build(small, 3)()
    image = Frame("a", EPOCH, 0, 0, np.zeros((7, 1), np.uint8))
    assert refuse(encode(image), small)[0] == ErrorCode.too_large
    name = Control("abcd", EPOCH, 0, np.zeros(1))
    assert refuse(encode(name), small)[0] == ErrorCode.bad_key


def test_wider_limits_let_larger_messages_through():
    wide = Limits(max_control_size=100)
    message = Control("a", EPOCH, 0, np.zeros(100), limits=wide)
    assert isinstance(decode(encode(message), wide), Control)
    assert refuse(encode(message))[0] == ErrorCode.too_large


@pytest.mark.parametrize(
    "bad", [{"max_horizon": 0}, {"max_code_size": 2.0}, {"max_name_length": 201}]
)
def test_limits_check_themselves(bad):
    with pytest.raises(ValueError, match="expected"):
        Limits(**bad)
