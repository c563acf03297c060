"""The codec: identity on every message, one typed error on everything else."""

from __future__ import annotations

from dataclasses import fields

import hypothesis.strategies as st
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings

from koop_protocol import (
    Control,
    ErrorCode,
    ErrorReply,
    Frame,
    LqrQuery,
    LqrTask,
    Message,
    PredictQuery,
    ProtocolError,
    decode,
    decode_as,
    encode,
)

from .any_message import messages


def assert_same(left: Message, right: Message) -> None:
    assert type(left) is type(right)
    for name in (field.name for field in fields(left)):
        a, b = getattr(left, name), getattr(right, name)
        assert type(a) is type(b), name
        if isinstance(a, LqrQuery):
            assert_same(a, b)
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype, name
            np.testing.assert_array_equal(a, b, err_msg=name)
        else:
            assert a == b, name


def decode_or_error(data: bytes) -> Message | ProtocolError:
    """What decode makes of the bytes; any exception but ProtocolError fails the test."""
    try:
        return decode(data)
    except ProtocolError as error:
        refusal = error
    # It must be fit to be sent back.
    assert ErrorReply.from_error(refusal).code in set(ErrorCode)
    return refusal


@given(messages)
@settings(max_examples=400)
def test_decoding_after_encoding_is_the_identity(message):
    assert_same(decode(encode(message)), message)


@given(messages)
def test_encoding_is_the_same_for_a_decoded_message(message):
    data = encode(message)
    assert encode(decode(memoryview(data))) == data


@given(st.binary(max_size=300))
@settings(max_examples=400)
def test_arbitrary_bytes_give_one_typed_error(data):
    assert isinstance(decode_or_error(data), ProtocolError)


@given(messages, st.data())
@settings(max_examples=400)
def test_a_changed_byte_gives_a_message_or_one_typed_error(message, data):
    changed = bytearray(encode(message))
    at = data.draw(st.integers(0, len(changed) - 1))
    changed[at] = data.draw(st.integers(0, 255))
    decode_or_error(bytes(changed))


@given(messages, st.data())
def test_a_cut_message_gives_one_typed_error(message, data):
    whole = encode(message)
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    assert isinstance(decode_or_error(cut), ProtocolError)


@given(messages)
def test_trailing_bytes_give_one_typed_error(message):
    assert isinstance(decode_or_error(encode(message) + b"\0"), ProtocolError)


anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=9)
    | st.binary(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner),
    max_leaves=8,
)


@given(messages, st.data(), anything)
@settings(max_examples=400)
def test_any_value_in_any_field_gives_a_message_or_one_typed_error(message, data, value):
    entries = msgpack.unpackb(encode(message))
    inside = [entries, *(entry for entry in entries.values() if isinstance(entry, dict) and entry)]
    target = data.draw(st.sampled_from(inside))
    target[data.draw(st.sampled_from(sorted(target)))] = value
    decode_or_error(msgpack.packb(entries))


def control_map(**changes: object) -> bytes:
    u = {"dtype": "f8", "shape": [1], "data": bytes(8)}
    entries = {"v": 1, "type": "control", "trajectory": "a", "epoch": "0" * 16, "seq": 0, "u": u}
    return msgpack.packb({**entries, **changes})


def code_of(data: bytes) -> str:
    with pytest.raises(ProtocolError) as caught:
        decode(data)
    return caught.value.code


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"v": 2}, ErrorCode.unsupported_version),
        ({"v": 0}, ErrorCode.unsupported_version),
        ({"v": 2**64 - 1}, ErrorCode.unsupported_version),
        ({"v": True}, ErrorCode.wrong_type),
        ({"v": 1.0}, ErrorCode.wrong_type),
        ({"v": None}, ErrorCode.wrong_type),
        ({"type": "nonsense"}, ErrorCode.malformed),
        ({"type": 3}, ErrorCode.malformed),
        ({"type": ["control"]}, ErrorCode.malformed),
        ({"seq": None}, ErrorCode.malformed),
        ({"seq": -1}, ErrorCode.malformed),
        ({"seq": 2**53}, ErrorCode.too_large),
        ({"seq": 1.0}, ErrorCode.wrong_type),
        ({"seq": True}, ErrorCode.wrong_type),
        ({"trajectory": "@a"}, ErrorCode.bad_key),
        ({"epoch": "0" * 15}, ErrorCode.malformed),
        ({"u": [0.0]}, ErrorCode.wrong_type),
        ({"u": {"dtype": "f8", "shape": [1]}}, ErrorCode.wrong_type),
        ({"u": {"dtype": "f8", "shape": [1], "data": "00000000"}}, ErrorCode.wrong_type),
        ({"u": {"dtype": "i8", "shape": [1], "data": bytes(8)}}, ErrorCode.wrong_dtype),
        ({"u": {"dtype": "u1", "shape": [8], "data": bytes(8)}}, ErrorCode.wrong_dtype),
        ({"u": {"dtype": ["f8"], "shape": [1], "data": bytes(8)}}, ErrorCode.wrong_dtype),
        ({"u": {"dtype": "f8", "shape": [True], "data": bytes(8)}}, ErrorCode.wrong_shape),
        ({"u": {"dtype": "f8", "shape": [-1, -1], "data": bytes(8)}}, ErrorCode.wrong_shape),
        ({"u": {"dtype": "f8", "shape": [], "data": bytes(8)}}, ErrorCode.wrong_shape),
        ({"u": {"dtype": "f8", "shape": [0], "data": b""}}, ErrorCode.wrong_shape),
        ({"u": {"dtype": "f8", "shape": [1] * 5, "data": bytes(8)}}, ErrorCode.wrong_shape),
        ({"u": {"dtype": "f8", "shape": 1, "data": bytes(8)}}, ErrorCode.wrong_shape),
        ({"u": {"dtype": "f8", "shape": [1, 1], "data": bytes(8)}}, ErrorCode.wrong_shape),
        ({"u": {"dtype": "f8", "shape": [2], "data": bytes(8)}}, ErrorCode.wrong_shape),
    ],
)
def test_a_malformed_map_names_what_was_wrong(change, code):
    assert code_of(control_map(**change)) == code


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x01", msgpack.packb([1]), b"\x81\xa1v\x01\x00"])
def test_bytes_that_are_no_message_are_malformed(data):
    assert code_of(data) in (ErrorCode.malformed, ErrorCode.wrong_type)


def test_an_unsupported_version_says_which_one_is_supported():
    with pytest.raises(ProtocolError, match="version 9; expected version 1") as caught:
        decode(control_map(v=9, type="from_the_future"))
    assert caught.value.details["supported"] == 1


def test_a_key_held_twice_is_malformed():
    first = control_map()
    assert first[0] == 0x86
    twice = b"\x87" + first[1:] + msgpack.packb("seq") + msgpack.packb(5)
    assert code_of(twice) == ErrorCode.malformed


def test_unknown_keys_are_ignored():
    message = decode_as(Control, control_map(later={"nested": [1, {"a": None}]}, limits=3))
    assert message.seq == 0


def test_nil_stands_for_an_absent_field():
    entries = {"v": 1, "type": "predict_query", "horizon": 3, "controls": None}
    query = decode_as(PredictQuery, msgpack.packb(entries))
    assert query.controls is None
    assert query.returns == {"codes"}


def test_another_type_than_asked_for_is_malformed():
    with pytest.raises(ProtocolError, match="'control' came; expected one of type 'frame'"):
        decode_as(Frame, control_map())


def test_a_query_inside_a_task_is_read_as_strictly_as_one_alone():
    task = msgpack.unpackb(encode(LqrTask("me", LqrQuery(5, target_code=np.zeros(2)))))
    assert "v" not in task["query"]
    assert "type" not in task["query"]
    for change, code in (
        ({"horizon": 0}, ErrorCode.bad_horizon),
        ({"horizon": None}, ErrorCode.malformed),
        ({"r": float("nan")}, ErrorCode.not_finite),
        ({"returns": ["codes"]}, ErrorCode.malformed),
    ):
        changed = {**task, "query": {**task["query"], **change}}
        assert code_of(msgpack.packb(changed)) == code
    assert code_of(msgpack.packb({**task, "query": "all"})) == ErrorCode.wrong_type


def test_decoded_arrays_are_read_only_and_outlive_the_buffer():
    frame = Frame("a", "0" * 16, 0, 0, np.arange(6, dtype=np.float32).reshape(2, 3))
    buffer = bytearray(encode(frame))
    image = decode_as(Frame, buffer).image
    buffer[:] = bytes(len(buffer))
    assert not image.flags.writeable
    assert not image.flags.owndata
    np.testing.assert_array_equal(image, frame.image)


def test_an_image_of_any_memory_layout_travels_in_c_order():
    image = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    for view in (image.transpose(1, 0, 2), image[:, ::-1], np.asfortranarray(image)):
        frame = Frame("a", "0" * 16, 0, 0, view)
        np.testing.assert_array_equal(decode_as(Frame, encode(frame)).image, view)
