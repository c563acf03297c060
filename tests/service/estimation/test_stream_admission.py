"""Which messages a stream admits, from epoch to epoch; what is no measurement is refused."""

import numpy as np
import pytest

from koop_service.estimation.stream import Admission

from .stream_messages import EPOCH, OTHER, Message, code_of, feed, in_order, make, seqs


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
