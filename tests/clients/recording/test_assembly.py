"""A stream is cut as docs/wire.md says, whatever the order in which it comes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_clients.recording import assembly
from koop_clients.recording.assembly import Assembly, Segment, Shot

EPOCH, OTHER = "a" * 16, "b" * 16


def shot(seq: int, **changes: str) -> Shot:
    """A picture that tells its number."""
    return Shot(np.full((64, 64), seq % 256, np.uint8), 0.05 * seq, **changes)


def control(seq: int) -> np.ndarray:
    return np.array([seq + 0.5])


def fill(
    target: Assembly, frames: Iterable[int], epoch: str = EPOCH, lost: tuple[int, ...] = ()
) -> list[Segment]:
    """Each frame and the control that follows it, but for the controls lost."""
    segments = []
    for seq in frames:
        segments += target.add_frame(epoch, seq, shot(seq))
        if target.control_size and seq not in lost:
            segments += target.add_control(epoch, seq, control(seq))
    return segments


def assert_true(segment: Segment) -> None:
    """Frames are consecutive, and control k stands between frames k and k+1."""
    numbers = segment.seq + np.arange(len(segment.frames))
    assert np.array_equal(segment.frames[:, 0, 0], numbers % 256)
    assert np.allclose(segment.times, 0.05 * numbers)
    if segment.controls.shape[1]:
        assert np.array_equal(segment.controls[:, 0], numbers[:-1] + 0.5)


def test_a_whole_stream_is_cut_into_equal_segments() -> None:
    target = Assembly("a", 4, 1)
    segments = fill(target, range(11))
    assert [segment.seq for segment in segments] == [0, 4]
    assert [s.frames.shape for s in segments] == [(4, 64, 64)] * 2
    assert [s.controls.shape for s in segments] == [(3, 1)] * 2
    target.finish()
    assert target.dropped == {assembly.END: 3}


def test_a_plant_without_a_motor_has_no_controls() -> None:
    (segment,) = fill(Assembly("a", 5, 0), range(5))
    assert segment.controls.shape == (4, 0)
    assert_true(segment)


def test_a_late_join_starts_with_what_came() -> None:
    segments = fill(Assembly("a", 4, 1), range(100, 112))
    assert [segment.seq for segment in segments] == [100, 104, 108]


def test_a_gap_starts_a_new_segment() -> None:
    target = Assembly("a", 5, 1)
    segments = fill(target, [*range(8), *range(9, 25)])
    assert [segment.seq for segment in segments] == [0, 9, 14, 19]
    assert target.dropped == {assembly.GAP: 3}


def test_a_missing_control_starts_a_new_segment() -> None:
    target = Assembly("a", 5, 1)
    segments = fill(target, range(22), lost=(7,))
    assert [segment.seq for segment in segments] == [0, 8, 13]
    assert target.dropped == {assembly.NO_CONTROL: 3}


def test_a_control_is_waited_for_as_long_as_the_service_does() -> None:
    for frames_after, kept in ((8, True), (9, False)):
        target = Assembly("a", 3, 1)
        fill(target, range(2 + frames_after), lost=(0,))
        late = target.add_control(EPOCH, 0, control(0))
        assert bool(late) == kept, frames_after


def test_a_new_epoch_starts_afresh_and_the_old_one_is_over() -> None:
    target = Assembly("a", 4, 1)
    fill(target, range(6))
    assert [segment.epoch for segment in fill(target, range(4), OTHER)] == [OTHER]
    assert fill(target, range(6, 20)) == []
    assert target.dropped == {assembly.NEW_EPOCH: 2, assembly.STALE: 14}


def test_a_change_of_the_image_starts_a_new_segment() -> None:
    target = Assembly("a", 4, 0)
    segments = fill(target, range(6))
    for seq in range(6, 10):
        segments += target.add_frame(EPOCH, seq, shot(seq, format="<f4"))
    assert [segment.seq for segment in segments] == [0, 6]
    assert target.dropped == {assembly.CHANGED: 2}


def test_what_comes_ahead_is_bounded() -> None:
    target = Assembly("a", 4, 1)
    target.add_frame(EPOCH, 0, shot(0))
    for seq in range(1000, 0, -1):
        target.add_control(EPOCH, seq, control(seq))
    assert sorted(target._controls) == list(range(1, 81))


MESSAGES = st.lists(st.tuples(st.booleans(), st.integers(0, 30)), max_size=120)


@settings(max_examples=200, deadline=None)
@given(MESSAGES, st.integers(0, 1), st.integers(2, 6))
def test_whatever_comes_segments_are_true_and_every_frame_is_accounted_for(
    messages: list[tuple[bool, int]], control_size: int, length: int
) -> None:
    target, segments, frames = Assembly("a", length, control_size), [], 0
    for is_frame, seq in messages:
        if is_frame:
            frames += 1
            segments += target.add_frame(EPOCH, seq, shot(seq))
        elif control_size:
            segments += target.add_control(EPOCH, seq, control(seq))
    target.finish()
    for segment in segments:
        assert_true(segment)
    numbers = [segment.seq + i for segment in segments for i in range(length)]
    assert len(set(numbers)) == len(numbers)
    assert len(numbers) + sum(target.dropped.values()) == frames


@settings(max_examples=100, deadline=None)
@given(st.randoms(use_true_random=False))
def test_no_order_within_the_limit_changes_anything(random) -> None:
    """Blocks of 4 frames and their controls come shuffled."""
    target, segments = Assembly("a", 5, 1), []
    for start in range(0, 40, 4):
        block = [(kind, seq) for seq in range(start, start + 4) for kind in ("frame", "control")]
        random.shuffle(block)
        for kind, seq in block:
            if kind == "frame":
                segments += target.add_frame(EPOCH, seq, shot(seq))
            else:
                segments += target.add_control(EPOCH, seq, control(seq))
    assert [segment.seq for segment in segments] == list(range(0, 40, 5))
    for segment in segments:
        assert_true(segment)
