"""The stream's fold against a brute-force reference that looks at prefixes of the arrivals."""

import itertools
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import COUNTERS, Admission, Stream

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


# The reference: numbers only, from the definitions in the module's docstring.


def first_arrivals(messages, kind):
    arrivals = {}
    for time, message in enumerate(messages):
        if message.kind == kind:
            arrivals.setdefault(message.seq, time)
    return arrivals


def fold_times(arrivals, limit, end):
    """When each frame is folded: it came in time, and so did or never will every one below it."""

    def higher(seq, time):
        return sum(other > seq and came <= time for other, came in arrivals.items())

    accepted = {seq for seq, came in arrivals.items() if higher(seq, came) <= limit}

    def settled(seq, time):
        return higher(seq, time) > limit or (seq in accepted and arrivals[seq] <= time)

    times = {}
    for seq in sorted(accepted):
        for time in range(arrivals[seq], end):
            if all(settled(below, time) for below in range(seq)):
                times[seq] = time
                break
    return times


def expected(messages, history, control_size, limit):
    """Numbers of the transitions that must be emitted, and how many controls are given up."""
    times = fold_times(first_arrivals(messages, "frame"), limit, len(messages))
    controls = first_arrivals(messages, "control")
    folded = sorted(times)
    emitted, missing = [], 0
    for index, newest in enumerate(folded):
        k = newest - 1
        if not set(range(k - history + 1, k + 2)) <= set(folded):
            continue
        last_chance = index + limit + 1
        deadline = times[folded[last_chance]] if last_chance < len(folded) else None
        if control_size == 0 or (k in controls and (deadline is None or controls[k] < deadline)):
            emitted.append(k)
        elif deadline is not None:
            missing += 1
        else:
            break
    return emitted, missing


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


# Memory


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


# Admission and epochs


def test_admission_is_a_question_and_changes_only_the_count():
    stream = make()
    feed(stream, in_order(5))
    before = stream.snapshot()
    assert stream.admit_frame(EPOCH, 5) is Admission.ACCEPTED
    assert stream.admit_frame(OTHER, 0) is Admission.NEW_EPOCH
    np.testing.assert_equal(stream.snapshot(), before)
    assert stream.admit_frame(EPOCH, 4) is Admission.DUPLICATE
    assert stream.counters["duplicates"] == before["counters"]["duplicates"] + 1


def test_a_frame_before_the_last_gap_is_late_not_a_duplicate():
    stream = make(limit=0)
    feed(stream, [Message("frame", seq) for seq in (0, 1, 4)])
    assert stream.admit_frame(EPOCH, 2) is Admission.LATE
    assert stream.admit_frame(EPOCH, 4) is Admission.DUPLICATE
    assert stream.counters["gaps"] == 1
    assert stream.counters["missing_frames"] == 2


def test_a_waiting_frame_is_a_duplicate_when_it_comes_again():
    stream = make()
    feed(stream, [Message("frame", 3)])
    assert stream.admit_frame(EPOCH, 3) is Admission.DUPLICATE
    assert stream.missing == (0, 3)


def test_a_new_epoch_starts_afresh_and_the_old_one_is_stale():
    stream = make()
    feed(stream, in_order(10))
    assert seqs(feed(stream, in_order(4), OTHER)) == [1, 2]
    assert (stream.epoch, stream.frames, stream.next_seq) == (OTHER, 4, 4)
    assert feed(stream, in_order(12)[20:], EPOCH) == []
    assert stream.counters["stale_epoch"] == 4
    assert stream.counters["frames"] == 14


def test_a_control_may_open_an_epoch():
    stream = make()
    assert feed(stream, [Message("control", 0)], OTHER) == []
    assert stream.epoch == OTHER
    assert seqs(feed(stream, in_order(3)[:1] + in_order(3)[2:], OTHER)) == [1]


def test_an_epoch_is_forgotten_after_eight_others():
    stream = make()
    for i in range(9):
        stream.fold_frame(f"{i:016x}", 0, code_of(0))
    assert stream.admit_frame(f"{0:016x}", 1) is Admission.STALE_EPOCH
    stream.fold_frame(f"{9:016x}", 0, code_of(0))
    assert stream.admit_frame(f"{0:016x}", 1) is Admission.NEW_EPOCH
    assert stream.retired == tuple(f"{i:016x}" for i in range(1, 9))


def test_joining_late_is_counted_as_such_and_loses_no_frame():
    stream = make(limit=3)
    transitions = feed(stream, in_order(5020)[2 * 5000 :])
    assert seqs(transitions) == list(range(5001, 5019))
    assert (stream.counters["late_join"], stream.counters["gaps"]) == (1, 0)
    assert stream.counters["missing_frames"] == 0


# What prediction and replay need


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


def test_what_is_kept_is_a_copy():
    stream, code = make(control_size=0), np.zeros(2)
    transitions = []
    for seq in range(4):
        code[:] = seq
        transitions += stream.fold_frame(EPOCH, seq, code)
    np.testing.assert_array_equal(transitions[0].w, [0.0, 0.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("seq", "code", "problem"),
    [
        (0, np.zeros(3), "shape"),
        (0, np.zeros((1, 2)), "shape"),
        (0, np.array([0.0, np.nan]), "NaN"),
        (0, np.array([0.0, np.inf]), "infinity"),
        (-1, np.zeros(2), "number -1"),
    ],
)
def test_bad_measurements_are_refused_and_change_nothing(seq, code, problem):
    stream = make(control_size=2)
    before = stream.snapshot()
    with pytest.raises(ValueError, match=problem):
        stream.fold_frame(EPOCH, seq, code)
    with pytest.raises(ValueError, match=problem):
        stream.fold_control(EPOCH, seq, code)
    np.testing.assert_equal(stream.snapshot(), before)


def test_a_negative_reorder_limit_is_refused():
    with pytest.raises(ValueError, match="reorder_limit"):
        make(limit=-1)


def assert_same(one, other):
    assert seqs(one) == seqs(other)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.w, b.w)
        np.testing.assert_array_equal(a.y, b.y)


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


def held(snapshot):
    """Codes, windows and controls that a snapshot holds."""
    lists = itertools.chain(snapshot["order"].items(), snapshot["join"].items())
    names = ("pending_codes", "run", "window_codes", "controls", "spent_controls")
    return sum(len(value) for name, value in lists if name in names)
