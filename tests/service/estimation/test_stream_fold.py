"""The stream's fold against a brute-force reference, and whatever order messages come in."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.estimation.stream import COUNTERS

from .stream_messages import (
    EPOCH,
    anything,
    assert_same,
    code_of,
    control_of,
    feed,
    in_order,
    make,
    nearly_ordered,
    seqs,
)
from .stream_reference import expected


@settings(max_examples=300, deadline=None)
@given(
    st.one_of(anything(), nearly_ordered()), st.integers(1, 3), st.integers(0, 1), st.integers(0, 4)
)
def test_emits_exactly_what_the_reference_does(messages, history, control_size, limit):
    if control_size == 0:
        messages = [m for m in messages if m.kind == "frame"]
    stream = make(history, control_size, limit)
    transitions = feed(stream, messages)
    emitted, missing = expected(messages, history, control_size, limit)
    assert seqs(transitions) == emitted
    assert stream.counters["missing_controls"] == missing


@settings(deadline=None)
@given(nearly_ordered(), st.integers(1, 3), st.integers(0, 4), st.booleans())
def test_no_transition_straddles_a_gap(messages, history, limit, affine):
    for transition in feed(make(history, 1, limit, affine), messages):
        k = transition.seq
        window = [code_of(seq) for seq in range(k - history + 1, k + 1)]
        regressor = np.concatenate([*window, control_of(k), [1.0] * affine])
        np.testing.assert_array_equal(transition.w, regressor)
        np.testing.assert_array_equal(transition.y, code_of(k + 1))


@settings(deadline=None)
@given(st.data(), st.integers(0, 8))
def test_interleaving_within_the_limit_changes_nothing(data, limit):
    stream = in_order(30)
    lost = data.draw(st.sets(st.sampled_from(stream), max_size=8), label="lost")
    lossy = [m for m in stream if m not in lost]
    delays = data.draw(
        st.lists(st.integers(0, limit), min_size=len(lossy), max_size=len(lossy)), label="delays"
    )
    delayed = zip(lossy, delays, strict=True)
    shuffled = [m for m, _ in sorted(delayed, key=lambda item: item[0].seq + item[1])]
    tidy, mixed = make(limit=limit), make(limit=limit)
    assert_same(feed(tidy, lossy), feed(mixed, shuffled))
    # A control that no window can ask for is taken or late, as it comes before its frame or after.
    taken = [name for name in COUNTERS if name not in ("controls", "late")]
    assert [tidy.counters[name] for name in taken] == [mixed.counters[name] for name in taken]


@settings(deadline=None)
@given(nearly_ordered(), st.integers(0, 4), st.data())
def test_duplicates_change_nothing(messages, limit, data):
    once, often = make(limit=limit), make(limit=limit)
    again, seen = [], []
    for m in messages:
        seen.append(m)
        again += [m, *data.draw(st.lists(st.sampled_from(seen), max_size=2))]
    assert_same(feed(once, messages), feed(often, again))
    refused = {"duplicates", "late"}
    taken = [name for name in COUNTERS if name not in refused]
    assert [once.counters[name] for name in taken] == [often.counters[name] for name in taken]


@settings(deadline=None)
@given(anything(), st.integers(0, 4))
def test_every_frame_is_accounted_for(messages, limit):
    stream = make(limit=limit)
    frames = [m for m in messages if m.kind == "frame"]
    feed(stream, frames)
    counted = sum(stream.counters[name] for name in ("frames", "duplicates", "late"))
    assert counted + len(stream.snapshot()["order"]["pending_seqs"]) == len(frames)


def test_what_is_kept_is_a_copy():
    stream, code = make(control_size=0), np.zeros(2)
    transitions = []
    for seq in range(4):
        code[:] = seq
        transitions += stream.fold_frame(EPOCH, seq, code)
    np.testing.assert_array_equal(transitions[0].w, [0.0, 0.0, 1.0, 1.0])
