"""Streams of numbered frames and controls, and what tests ask of the transitions made of them."""

from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st

from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import Stream

EPOCH = "00000000000000aa"
OTHER = "00000000000000bb"


class Message(NamedTuple):
    kind: str
    seq: int


def code_of(seq):
    """A code that tells its frame's number."""
    return np.array([seq, 0.5 - seq])


def control_of(seq):
    return np.array([1000.0 + seq])


def feed(stream, messages, epoch=EPOCH):
    transitions = []
    for message in messages:
        if message.kind == "frame":
            transitions += stream.fold_frame(epoch, message.seq, code_of(message.seq))
        else:
            transitions += stream.fold_control(epoch, message.seq, control_of(message.seq))
    return transitions


def seqs(transitions):
    return [transition.seq for transition in transitions]


def make(history=2, control_size=1, limit=8, affine=False):
    return Stream(EstimatorSettings(2, history, control_size, affine), reorder_limit=limit)


def in_order(count, control_size=1):
    kinds = ("frame", "control") if control_size else ("frame",)
    return [Message(kind, seq) for seq in range(count) for kind in kinds]


def message(numbers):
    return st.builds(Message, st.sampled_from(["frame", "control"]), numbers)


def anything():
    """Arbitrary numbers in arbitrary order, with duplicates."""
    return st.lists(message(st.integers(0, 20)), max_size=90)


@st.composite
def nearly_ordered(draw):
    """A stream with losses, duplicates and local disorder, some of it beyond any small limit."""
    stream = in_order(draw(st.integers(1, 24)))
    delays = draw(
        st.lists(
            st.sampled_from([None, 0, 0, 0, 1, 2, 3, 6, 12]),
            min_size=len(stream),
            max_size=len(stream),
        )
    )
    repeats = draw(st.lists(st.tuples(st.sampled_from(stream), st.integers(0, 12)), max_size=6))
    sent = [(m, delay) for m, delay in zip(stream, delays, strict=True) if delay is not None]
    return [m for m, _ in sorted(sent + repeats, key=lambda item: item[0].seq + item[1])]


def assert_same(one, other):
    assert seqs(one) == seqs(other)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.w, b.w)
        np.testing.assert_array_equal(a.y, b.y)
