"""What a stream knows for prediction, and how it goes on from a snapshot."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import Stream

from .stream_messages import (
    Message,
    assert_same,
    code_of,
    control_of,
    feed,
    in_order,
    make,
    nearly_ordered,
)


def test_history_is_the_newest_codes_and_none_across_a_gap():
    stream = make(history=3, limit=0)
    feed(stream, in_order(2))
    assert stream.history is None
    feed(stream, in_order(5)[4:])
    np.testing.assert_array_equal(stream.history, [code_of(2), code_of(3), code_of(4)])
    feed(stream, [Message("frame", 9)])
    assert stream.history is None


def test_last_control_is_the_newest_that_has_acted_or_acts_now():
    stream = make()
    assert stream.last_control is None
    feed(stream, in_order(5))
    assert_control(stream.last_control, 4)
    feed(stream, [Message("control", 700), Message("frame", 5)])
    assert_control(stream.last_control, 4)
    feed(stream, [Message("control", 5)])
    assert_control(stream.last_control, 5)


def test_replaying_from_where_the_snapshot_says_gives_the_state_without_the_crash():
    messages = in_order(40)
    # Frame 17 and control 11 were on the way when the service died.
    before = [m for m in messages[:44] if m not in (Message("frame", 17), Message("control", 11))]
    crashed, whole = make(), make()
    emitted = feed(crashed, before)
    restored = Stream.restore(crashed.settings, crashed.snapshot())
    assert restored.replay_from == 11
    emitted += feed(restored, [m for m in messages if m.seq >= restored.replay_from])
    assert_same(emitted, feed(whole, messages))


@settings(deadline=None)
@given(nearly_ordered(), st.integers(0, 4), st.data())
def test_a_restored_snapshot_has_the_same_future(messages, limit, data):
    cut = data.draw(st.integers(0, len(messages)))
    live = make(limit=limit)
    feed(live, messages[:cut])
    snapshot = live.snapshot()
    restored = Stream.restore(live.settings, snapshot)
    assert_same(feed(live, messages[cut:]), feed(restored, messages[cut:]))
    np.testing.assert_equal(restored.snapshot(), live.snapshot())
    assert_plain(snapshot)


def test_a_snapshot_of_another_model_is_refused():
    snapshot = make(history=2).snapshot()
    with pytest.raises(ValueError, match="another model"):
        Stream.restore(EstimatorSettings(2, 3, 1), snapshot)


def assert_control(control, seq):
    assert control is not None
    assert control[0] == seq
    np.testing.assert_array_equal(control[1], control_of(seq))


def assert_plain(value: Any):
    if isinstance(value, dict):
        assert all(isinstance(key, str) for key in value)
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            assert_plain(item)
    else:
        assert value is None or type(value) in (int, str, np.ndarray)
