"""The codec: identity on every message, one typed error on everything else."""

from __future__ import annotations

from dataclasses import fields

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings

from koop_protocol import (
    Command,
    Control,
    EndReason,
    ErrorCode,
    ErrorReply,
    Frame,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    Message,
    PredictQuery,
    PredictReply,
    ProtocolError,
    StateReply,
    decode,
    decode_as,
    encode,
)

IMAGE_DTYPES = (np.uint8, np.float16, np.float32)
FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
POSITIVE = st.floats(1e-6, 1e6)

chunk = st.text("abcXYZ019_.-", min_size=1, max_size=8)
trajectories = st.lists(chunk, min_size=1, max_size=3).map("/".join)
epochs = st.binary(min_size=8, max_size=8).map(bytes.hex)
sequences = st.integers(0, 2**53 - 1)
words = st.text(max_size=20).filter(lambda word: word.isprintable())


def arrays(dtype, shape):
    return hnp.arrays(
        dtype,
        shape,
        elements={"allow_nan": False, "allow_infinity": False}
        if np.dtype(dtype).kind == "f"
        else None,
    )


def images(rows=()):
    shapes = st.lists(st.integers(1, 4), min_size=2, max_size=3).map(tuple)
    return st.sampled_from(IMAGE_DTYPES).flatmap(
        lambda dtype: shapes.flatmap(lambda shape: arrays(dtype, (*rows, *shape)))
    )


def codes(rows, n):
    return st.sampled_from((np.float32, np.float64)).flatmap(lambda d: arrays(d, (rows, n)))


def subsets(*parts, at_least=0):
    return st.sets(st.sampled_from(parts), min_size=at_least).map(frozenset)


frames = st.builds(
    Frame, trajectories, epochs, sequences, st.integers(0, 64), images(), renderer=words
)
controls = st.builds(Control, trajectories, epochs, sequences, arrays(np.float64, 3))


@st.composite
def predict_queries(draw):
    horizon = draw(st.integers(1, 30))
    future = draw(st.none() | arrays(np.float64, (horizon, 2)))
    return PredictQuery(horizon, future, draw(subsets("codes", "frames", "std", at_least=1)))


@st.composite
def predict_replies(draw):
    rows, n = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    parts = draw(subsets("codes", "frames", "std", at_least=1))
    return PredictReply(
        draw(trajectories),
        draw(epochs),
        draw(sequences),
        draw(codes(rows, n)) if "codes" in parts else None,
        draw(images((rows,))) if "frames" in parts else None,
        draw(codes(rows, n)) if "std" in parts else None,
    )


def weights(size):
    """A number, a diagonal, or a positive definite matrix."""
    diagonal = hnp.arrays(np.float64, size, elements=POSITIVE)
    return POSITIVE | diagonal | diagonal.map(np.diag)


PARTS = subsets("codes", "frames")


@st.composite
def lqr_queries(draw, returns=PARTS):
    n, p = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    by_code = draw(st.booleans())
    low, high = st.floats(-9, 0), st.floats(0, 9)
    rows = draw(st.sampled_from([(), (3,)]))
    m = draw(st.integers(0, 2))
    return LqrQuery(
        draw(st.integers(1, 1000)),
        target_image=None if by_code else draw(images()),
        target_code=draw(arrays(np.float64, (*rows, n))) if by_code else None,
        q=draw(weights(n)),
        r=draw(weights(p)),
        u_min=draw(st.none() | hnp.arrays(np.float64, p, elements=low)),
        u_max=draw(st.none() | hnp.arrays(np.float64, p, elements=high)),
        returns=draw(returns),
        qf=draw(st.none() | st.just("riccati") | weights(n)),
        du_min=draw(st.none() | hnp.arrays(np.float64, p, elements=low)),
        du_max=draw(st.none() | hnp.arrays(np.float64, p, elements=high)),
        known_channels=tuple(range(m)) or None,
        known_controls=draw(arrays(np.float64, (2, m))) if m else None,
        delay=draw(st.integers(0, 1000)),
        method=draw(st.sampled_from(["qp", "gain"])),
        force=draw(st.booleans()),
    )


@st.composite
def lqr_replies(draw):
    rows, seq = draw(st.integers(1, 4)), draw(st.integers(0, 2**53 - 1001))
    controls, probing = draw(arrays(np.float64, (rows, 2))), draw(arrays(np.float64, (rows, 2)))
    fit = draw(st.booleans())
    return LqrReply(
        draw(trajectories),
        draw(epochs),
        seq,
        draw(words),
        draw(FINITE),
        draw(POSITIVE),
        controls if fit else draw(st.sampled_from([controls, None])),
        draw(st.none() | codes(rows, 3)),
        draw(st.none() | images((rows,))),
        draw(POSITIVE),
        start=seq + draw(st.integers(0, 1000)),
        fit=fit,
        reasons=tuple(draw(st.lists(words, max_size=3))),
        warnings=tuple(draw(st.lists(words, max_size=3))),
        modes=draw(st.none() | arrays(np.float64, (2, 4))),
        scores=draw(st.none() | arrays(np.float64, 2)),
        information=draw(st.none() | arrays(np.float64, 2)),
        residual=draw(POSITIVE),
        band=draw(POSITIVE),
        probing=draw(st.sampled_from([probing, None])),
    )


owners = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
tasks = st.builds(
    LqrTask,
    owners,
    lqr_queries(st.just(frozenset())),
    seconds=st.none() | POSITIVE,
    frozen=st.booleans(),
)


@st.composite
def commands(draw):
    seq = draw(st.integers(0, 2**53 - 1001))
    return Command(
        draw(trajectories),
        draw(epochs),
        seq,
        seq + draw(st.integers(0, 1000)),
        draw(arrays(np.float64, (3, 2))),
        draw(words),
        draw(FINITE),
        draw(POSITIVE),
        draw(owners),
    )


ends = st.builds(LqrEnd, trajectories, owners, st.sampled_from(EndReason), words)
states = st.builds(
    StateReply,
    trajectory=trajectories,
    epoch=epochs,
    next_seq=sequences,
    model=words,
    code_size=st.integers(1, 256),
    history=st.integers(1, 9),
    control_size=st.integers(0, 64),
    frames=sequences,
    updates=sequences,
    warmup_frames=sequences,
    ready=st.booleans(),
    residual_rms=POSITIVE,
    spectral_radius=POSITIVE,
    excitation=POSITIVE,
    counters=st.dictionaries(words, sequences, max_size=5),
)
errors = st.builds(
    ErrorReply,
    st.sampled_from(ErrorCode) | st.just("a_later_code"),
    words,
    st.dictionaries(words, words | st.integers(-(2**53) + 1, 2**53 - 1) | FINITE, max_size=5),
)
messages = st.one_of(
    frames,
    controls,
    predict_queries(),
    predict_replies(),
    lqr_queries(),
    lqr_replies(),
    tasks,
    st.builds(LqrCancel, owners),
    commands(),
    ends,
    states,
    errors,
)


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
