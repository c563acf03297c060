"""What a stream knows already and what it lacks: asked before a frame is folded."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from .stream_messages import EPOCH, Message, anything, code_of, feed, in_order, make, nearly_ordered

GIVEN_UP = ("gaps", "missing_frames", "missing_controls", "late_join")


@settings(deadline=None, max_examples=300)
@given(anything() | nearly_ordered(), st.integers(0, 1), st.integers(0, 4), st.integers(1, 4))
def test_nothing_is_given_up_without_being_foretold(messages, control_size, limit, history):
    stream = make(history, control_size, limit)
    for message in messages:
        if message.kind == "control":
            if control_size:
                feed(stream, [message])
            continue
        known, foretold = stream.knows_frame(message.seq), stream.lacks(message.seq)
        first, before = stream.replay_from, dict(stream.counters)
        awaited = [k for k in range(24) if control_size and not stream.knows_control(k)]
        feed(stream, [message])
        changed = any(stream.counters[name] != before[name] for name in GIVEN_UP)
        if (changed or any(map(stream.knows_control, awaited))) and not known:
            assert foretold is not None
            assert first < foretold <= max(message.seq, stream.next_seq - 1)


@settings(deadline=None)
@given(anything() | nearly_ordered())
def test_what_is_known_changes_nothing_but_a_count(messages):
    stream = make()
    for message in messages:
        known = stream.knows_frame if message.kind == "frame" else stream.knows_control
        if known(message.seq):
            before = stream.snapshot()
            assert feed(stream, [message]) == []
            after = stream.snapshot()
            for name in ("epoch", "retired", "order", "join"):
                np.testing.assert_equal(before[name], after[name])
        else:
            feed(stream, [message])
            assert known(message.seq) or message.kind == "control"


def test_a_missing_frame_is_lacked_from_the_first_later_one_on():
    stream = make(limit=2)
    feed(stream, in_order(3))
    assert stream.lacks(5) == 5
    feed(stream, [Message("frame", 5), Message("frame", 4)])
    assert stream.lacks(3) is None
    assert stream.lacks(6) == 4
    feed(stream, [Message("control", 3)])
    stream.fold_frame(EPOCH, 6, code_of(6))
    assert stream.counters["missing_frames"] == 1


def test_a_missing_control_is_lacked_once_it_would_be_given_up():
    stream = make(limit=2)
    feed(stream, [m for m in in_order(6) if m != Message("control", 2)])
    assert stream.lacks(6) == 3
    assert stream.lacks(9) == 9
    feed(stream, [Message("control", 2)])
    assert stream.lacks(6) is None
