"""The typed error and its message."""

from __future__ import annotations

import pickle

import pytest

from koop_protocol import ErrorCode, ErrorReply, ProtocolError, decode_as, encode

ERROR = ProtocolError(
    ErrorCode.warming_up,
    "warming up, 12 of 36 frames",
    "36 frames",
    "ask again in 24 frames",
    {"frames": 12, "warmup_frames": 36},
)


def test_the_sentence_has_all_parts():
    assert str(ERROR) == ("warming up, 12 of 36 frames; expected 36 frames; ask again in 24 frames")


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [(("a",), "a"), (("a", "b"), "a; expected b"), (("a", "", "c"), "a; c")],
)
def test_an_absent_part_leaves_no_trace(parts, sentence):
    assert str(ProtocolError(ErrorCode.internal, *parts)) == sentence


def test_it_is_a_value_error_and_survives_pickling():
    copy = pickle.loads(pickle.dumps(ERROR))
    assert isinstance(copy, ValueError)
    assert (copy.code, str(copy), copy.details) == (ERROR.code, str(ERROR), ERROR.details)


def test_it_reaches_the_other_end_whole():
    data = encode(ErrorReply.from_error(ERROR))
    error = decode_as(ErrorReply, data).to_error()
    assert error.code is ErrorCode.warming_up
    assert str(error) == str(ERROR)
    assert error.details == {"frames": 12, "warmup_frames": 36}


def test_a_long_sentence_is_cut_rather_than_refused():
    reply = ErrorReply.from_error(ProtocolError(ErrorCode.internal, "\ud800" + "ä" * 5000))
    assert reply.message == "?" + "ä" * 2047


def test_a_code_of_a_later_release_is_kept():
    reply = decode_as(ErrorReply, encode(ErrorReply("a_later_code", "something new")))
    assert reply.code == "a_later_code"


def test_a_field_is_named_in_the_sentence_and_the_details():
    with pytest.raises(ProtocolError, match=r"^message is 3 \(int\); expected a string") as caught:
        ErrorReply("internal", 3)  # pyright: ignore[reportArgumentType]
    assert caught.value.details == {"field": "message"}


def test_an_error_about_a_huge_value_stays_short():
    for value in ("x" * 10**6, b"x" * 10**6, list(range(10**5))):
        with pytest.raises(ProtocolError) as caught:
            ErrorReply("internal", "m", {"a": value})  # pyright: ignore[reportArgumentType]
        assert len(str(caught.value)) < 300
