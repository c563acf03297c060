"""What fits one file, and what is refused with which words."""

from __future__ import annotations

import numpy as np
import pytest

from koop_clients.recording.recorder import REFUSED, Recorder
from koop_protocol import Control, Frame

EPOCH = "0" * 16
IMAGE = np.arange(64 * 64, dtype=np.uint8).reshape(64, 64)


def frame(name: str, seq: int, image: np.ndarray = IMAGE, p: int = 0, renderer: str = "") -> Frame:
    return Frame(name, EPOCH, seq, p, image, renderer)


@pytest.fixture
def heard() -> list[str]:
    return []


@pytest.fixture
def recorder(heard: list[str]) -> Recorder:
    return Recorder(3, heard.append)


def test_trajectories_are_recorded_side_by_side(recorder: Recorder, heard: list[str]) -> None:
    segments = []
    for seq in range(6):
        for name in ("a", "b/1"):
            segments += recorder.take(frame(name, seq), 0.1 * seq)
    assert [(s.trajectory, s.seq) for s in segments] == [("a", 0), ("b/1", 0), ("a", 3), ("b/1", 3)]
    assert np.array_equal(segments[0].frames, [IMAGE] * 3)
    assert recorder.trajectories == ["a", "b/1"]
    assert recorder.frames == 12
    assert not recorder.dropped
    assert not heard


def test_floats_are_written_as_bytes(recorder: Recorder) -> None:
    image = (IMAGE / np.float32(255)).astype(np.float32)
    segments = [s for seq in range(3) for s in recorder.take(frame("a", seq, image), 0.0)]
    assert np.array_equal(segments[0].frames, [IMAGE] * 3)
    assert segments[0].frames.dtype == np.uint8


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (frame("x", 0, IMAGE[:32]), r"'x': its images are (32, 64); expected (64, 64)"),
        (frame("x", 0, np.stack([IMAGE] * 3)), "(3, 64, 64); expected (64, 64): crop and scale"),
        (frame("x", 0, np.full((64, 64), 9, np.float32)), "floats outside [0, 1]; divide them"),
        (frame("x", 0, p=2), "have 2 components; those of 'a', the first one recorded, 0"),
        (frame("x", 0, renderer="r"), "drawn by 'r'; 'a', the first one recorded, by a camera"),
    ],
)
def test_what_does_not_fit_is_refused_once_aloud_and_others_go_on(
    recorder: Recorder, heard: list[str], bad: Frame, words: str
) -> None:
    segments = recorder.take(frame("a", 0), 0.0)
    for seq in (1, 2):
        assert recorder.take(bad, 0.0) == []
        segments += recorder.take(frame("a", seq), 0.0)
    assert [s.trajectory for s in segments] == ["a"]
    assert recorder.dropped == {REFUSED: 2}
    assert recorder.trajectories == ["a"]
    (line,) = heard
    assert words in line


def test_a_control_of_another_size_is_refused(recorder: Recorder, heard: list[str]) -> None:
    recorder.take(frame("a", 0, p=1), 0.0)
    recorder.take(Control("a", EPOCH, 0, np.zeros(2)), 0.0)
    assert heard == ["refused 'a': a control has 2 components; expected 1, as its frames say"]
    recorder.take(Control("a", EPOCH, 0, np.ones(1)), 0.0)
    recorder.take(frame("a", 1, p=1), 0.0)
    recorder.take(Control("a", EPOCH, 1, np.ones(1)), 0.0)
    (segment,) = recorder.take(frame("a", 2, p=1), 0.0)
    assert np.array_equal(segment.controls, np.ones((2, 1)))


def test_a_control_of_nobody_is_passed_over(recorder: Recorder) -> None:
    assert recorder.take(Control("a", EPOCH, 0, np.zeros(1)), 0.0) == []


def test_a_segment_has_two_frames_at_least(heard: list[str]) -> None:
    with pytest.raises(ValueError, match="--frames is 1; expected 2 or more"):
        Recorder(1, heard.append)
