"""What a stream holds is bounded, whatever is sent; and the bound costs nothing that is needed."""

import itertools

import pytest

from .stream_messages import Message, code_of, feed, in_order, make, seqs


def hostile_sequences():
    return {
        "jumps": (Message("frame", 10**12 * i) for i in range(3000)),
        "backwards": (Message("frame", 10**12 - 2 * i) for i in range(3000)),
        "every other frame": (Message("frame", 2 * i) for i in range(3000)),
        "frames without controls": (Message("frame", i) for i in range(3000)),
        "controls without frames": (Message("control", i) for i in range(3000)),
        "controls far ahead": (Message("control", 10**12 - i) for i in range(3000)),
        "controls backwards amid frames": (
            Message(kind, seq)
            for i in range(1500)
            for kind, seq in (("frame", i), ("control", 10**6 - i))
        ),
    }


@pytest.mark.parametrize("name", hostile_sequences())
def test_memory_is_bounded_under_hostile_sequences(name):
    stream = make(limit=8)
    for m in hostile_sequences()[name]:
        feed(stream, [m])
        assert held(stream.snapshot()) <= 8 + 80 + 9 + 3 + 1


def test_memory_is_bounded_when_epochs_flap():
    stream = make()
    for i in range(3000):
        stream.fold_frame(f"{i % 20:016x}", i, code_of(i))
        snapshot = stream.snapshot()
        assert held(snapshot) <= 1
        assert len(snapshot["retired"]) <= 8


def test_a_long_ordered_stream_loses_nothing_and_holds_little():
    stream = make()
    assert seqs(feed(stream, in_order(2000))) == list(range(1, 1999))
    assert held(stream.snapshot()) <= 3 + 1 + 1


def test_controls_far_ahead_do_not_crowd_out_those_needed():
    stream = make()
    feed(stream, [Message("control", 10**12 - i) for i in range(1000)])
    assert seqs(feed(stream, in_order(40))) == list(range(1, 39))


def held(snapshot):
    """Codes, windows and controls that a snapshot holds."""
    lists = itertools.chain(snapshot["order"].items(), snapshot["join"].items())
    names = ("pending_codes", "run", "window_codes", "controls", "spent_controls")
    return sum(len(value) for name, value in lists if name in names)
