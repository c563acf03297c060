"""Replays and what a log need not keep: what the messages refuse, and what fits into one."""

from __future__ import annotations

import numpy as np
import pytest

from koop_protocol import (
    MAX_BATCH,
    SOURCE_TOKENS,
    Durable,
    ErrorCode,
    Frame,
    Limits,
    ProtocolError,
    ReplayQuery,
    ReplayReply,
    decode,
    encode,
    shard_of,
    source_token,
    trajectory_of,
)

from .refusing import EPOCH, refused

REPLY = {
    "trajectory": "cartpole/0",
    "messages": (b"a", b"b"),
    "position": 7,
    "end": False,
    "first_epoch": EPOCH,
    "first_seq": 0,
    "last_epoch": EPOCH,
    "last_seq": 9,
}


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"epoch": "A" * 16}, ErrorCode.malformed),
        ({"seq": -1}, ErrorCode.malformed),
        ({"seq": 2**53}, ErrorCode.too_large),
        ({"after": -1}, ErrorCode.malformed),
        ({"after": 1.0}, ErrorCode.wrong_type),
        ({"max_bytes": 0}, ErrorCode.malformed),
        ({"max_bytes": 2**22 + 1}, ErrorCode.too_large),
        ({"max_message_bytes": 0}, ErrorCode.malformed),
        ({"max_message_bytes": "1"}, ErrorCode.wrong_type),
    ],
)
def test_replay_query_refuses(change, code):
    assert refused(ReplayQuery, {"epoch": EPOCH}, **change).code == code


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"trajectory": "a b"}, ErrorCode.bad_key),
        ({"messages": (b"a", "b")}, ErrorCode.wrong_type),
        ({"messages": (b"a", b"")}, ErrorCode.malformed),
        ({"messages": b"ab"}, ErrorCode.wrong_type),
        ({"messages": (b"a",) * (MAX_BATCH + 1)}, ErrorCode.too_large),
        ({"position": -1}, ErrorCode.malformed),
        ({"end": 1}, ErrorCode.wrong_type),
        ({"first_seq": None}, ErrorCode.malformed),
        ({"last_epoch": None}, ErrorCode.malformed),
        ({"last_epoch": None, "last_seq": None}, ErrorCode.malformed),
        ({"last_epoch": "0"}, ErrorCode.malformed),
        ({"last_seq": -1}, ErrorCode.malformed),
        ({"dropped": -1}, ErrorCode.malformed),
    ],
)
def test_replay_reply_refuses(change, code):
    assert refused(ReplayReply, REPLY, **change).code == code


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"trajectory": ""}, ErrorCode.bad_key),
        ({"epoch": None}, ErrorCode.wrong_type),
        ({"seq": -1}, ErrorCode.malformed),
    ],
)
def test_durable_refuses(change, code):
    valid = {"trajectory": "cartpole/0", "epoch": EPOCH, "seq": 3}
    assert refused(Durable, valid, **change).code == code


def test_whatever_may_be_sent_alone_fits_into_a_reply():
    limits = Limits(max_message_bytes=5000)
    frame = Frame("x" * 200, EPOCH, 2**53 - 1, 64, np.zeros((1, 4600), np.uint8), logged=True)
    payload = encode(frame, limits)
    reply = ReplayReply(**{**REPLY, "trajectory": "x" * 200, "messages": (payload,)})
    with pytest.raises(ProtocolError):
        encode(reply, limits)
    data = encode(reply, limits.for_replays())
    back = decode(data, limits.for_replays())
    assert isinstance(back, ReplayReply)
    assert back.messages == (payload,)


def test_a_frame_that_is_not_logged_says_nothing_of_it():
    """So its bytes are those of the release before."""
    frame = Frame("a", EPOCH, 0, 0, np.zeros((1, 1), np.uint8))
    assert b"logged" not in encode(frame)
    assert decode(encode(frame)).logged is False


@pytest.mark.parametrize("name", ["cartpole/0", "a", "line3/robot7"])
def test_a_token_names_its_trajectory(name):
    token = source_token(name)
    assert trajectory_of(token) == name
    assert token.startswith(SOURCE_TOKENS.removesuffix("**"))


@pytest.mark.parametrize(
    "token",
    ["koop/@client/a", "koop/@source", "koop/@source/03", "koop/@source/04/a", "koop/@source/03/*"],
)
def test_what_is_no_source_s_token_is_refused(token):
    assert shard_of("a") == "03"
    with pytest.raises(ProtocolError) as caught:
        trajectory_of(token)
    assert caught.value.code == ErrorCode.bad_key
