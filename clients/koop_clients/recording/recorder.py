"""All trajectories of one recording: what fits the file, and what is refused, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from koop_clients.recording.assembly import Assembly, Segment, Shot
from koop_clients.recording.file import IMAGE_SIZE
from koop_protocol import Control, Frame

REFUSED = "refused"


@dataclass(frozen=True)
class _Stream:
    """What all trajectories of a file have in common: the size of a control, and the renderer."""

    control_size: int
    renderer: str


class Recorder:
    """Turns measurements into segments of `length` frames; no clock, no I/O.

    The first frame that is taken decides on control size and renderer of the file. `tell` gets one
    line for each trajectory that is refused, the first time.
    """

    def __init__(self, length: int, tell: Callable[[str], None]) -> None:
        if length < 2:
            raise ValueError(f"--frames is {length}; expected 2 or more")
        self.length = length
        self.frames = 0  # that came, refused ones too
        self._stream: _Stream | None = None
        self._tell = tell
        self._told: set[tuple[str, str]] = set()
        self._refused = 0
        self._first = ""
        self._assemblies: dict[str, Assembly] = {}

    @property
    def renderer(self) -> str:
        """What draws the frames; "" is a camera."""
        return self._stream.renderer if self._stream else ""

    @property
    def trajectories(self) -> list[str]:
        """Names of those that were taken, in order of their coming."""
        return list(self._assemblies)

    @property
    def dropped(self) -> Counter[str]:
        """Frames that ended in no segment, by why."""
        total = Counter({REFUSED: self._refused} if self._refused else {})
        for assembly in self._assemblies.values():
            total += assembly.dropped
        return total

    def take(self, message: Frame | Control, time: float) -> list[Segment]:
        """Take in what came at `time` [s]; the segments that it completes."""
        if isinstance(message, Control):
            return self._take_control(message)
        self.frames += 1
        problem = self._problem(message)
        if problem:
            self._refuse(message.trajectory, problem)
            self._refused += 1
            return []
        shot = Shot(as_uint8(message.image), time, message.image.dtype.str)
        return self._assembly(message).add_frame(message.epoch, message.seq, shot)

    def finish(self) -> None:
        """No more will come."""
        for assembly in self._assemblies.values():
            assembly.finish()

    def _take_control(self, control: Control) -> list[Segment]:
        assembly = self._assemblies.get(control.trajectory)
        if assembly is None:
            return []  # one that came before any frame: it cannot lead to one that was seen
        if len(control.u) != assembly.control_size:
            expected = f"{assembly.control_size}, as its frames say"
            self._refuse(
                control.trajectory,
                f"a control has {len(control.u)} components; expected {expected}",
            )
            return []
        return assembly.add_control(control.epoch, control.seq, control.u)

    def _assembly(self, frame: Frame) -> Assembly:
        if self._stream is None:
            self._stream = _Stream(frame.control_size, frame.renderer)
            self._first = frame.trajectory
        name = frame.trajectory
        if name not in self._assemblies:
            self._assemblies[name] = Assembly(name, self.length, frame.control_size)
        return self._assemblies[name]

    def _problem(self, frame: Frame) -> str:
        """What keeps a frame out of the file; empty if it fits."""
        found, size = frame.image.shape, (IMAGE_SIZE, IMAGE_SIZE)
        if found != size:
            return f"its images are {found}; expected {size}: crop and scale them before putting"
        if frame.image.dtype != np.uint8 and not _in_unit_range(frame.image):
            return "its images hold floats outside [0, 1]; divide them by 255, or put uint8"
        if self._stream is None:
            return ""
        if frame.control_size != self._stream.control_size:
            return (
                f"its controls have {frame.control_size} components; those of {self._first!r}, the "
                f"first one recorded, {self._stream.control_size}: record it into another file"
            )
        if frame.renderer != self._stream.renderer:
            return (
                f"it is drawn by {_drawn_by(frame.renderer)}; {self._first!r}, the first one "
                f"recorded, by {_drawn_by(self._stream.renderer)}: record it into another file"
            )
        return ""

    def _refuse(self, trajectory: str, problem: str) -> None:
        if (trajectory, problem) not in self._told:
            self._told.add((trajectory, problem))
            self._tell(f"refused {trajectory!r}: {problem}")


def as_uint8(image: np.ndarray) -> np.ndarray:
    """An image in uint8, or in floats in [0, 1], as uint8."""
    return image if image.dtype == np.uint8 else np.rint(255.0 * image).astype(np.uint8)


def _in_unit_range(image: np.ndarray) -> bool:
    return bool(image.min() >= 0.0 and image.max() <= 1.0)


def _drawn_by(renderer: str) -> str:
    return repr(renderer) if renderer else "a camera"
