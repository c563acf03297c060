"""One trajectory's stream cut into equal segments without a gap: a pure fold, no clock, no I/O.

It follows docs/wire.md, "What the service makes of a stream": frames and controls are joined by
(epoch, seq), and control k acts between frames k and k+1. A frame waits while at most 8 later ones
are held; a control is given up 9 frames after the frame it leads to. Where the service learns
nothing across a gap, a new segment begins here.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

REORDER_LIMIT = 8  # frames that may wait for a missing one
RETIRED_EPOCHS = 8  # ended runs whose messages are still recognised
_EARLY_CONTROLS = 8 * (REORDER_LIMIT + 2)

# What became of a frame that is in no segment, by why.
LATE = "duplicate or late"
STALE = "of an ended epoch"
GAP = "cut short by a gap"
NO_CONTROL = "cut short by a missing control"
NEW_EPOCH = "cut short by a new epoch"
CHANGED = "cut short by a change of the image"
END = "cut short by the end"


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame that came: its picture (64, 64) uint8, when [s], and its format on the wire."""

    image: np.ndarray
    time: float
    format: str = "u1"


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive frames (T, 64, 64), the controls (T-1, p) between them, and when they came [s].

    Its first frame is number `seq` of the epoch.
    """

    trajectory: str
    epoch: str
    seq: int
    frames: np.ndarray
    controls: np.ndarray
    times: np.ndarray


class _Ordered(NamedTuple):
    """The next frame in order; `broken` says why it does not continue the one before.

    `place` is the number of frames ordered up to it.
    """

    seq: int
    shot: Shot
    broken: str
    place: int


class Assembly:
    """Frames and controls of one trajectory on their way into segments of `length` frames.

    `dropped` counts frames that end in no segment, by why. Every frame added is in a segment, in
    `dropped`, or still held, and held no more after `finish`.
    """

    def __init__(self, trajectory: str, length: int, control_size: int) -> None:
        self.trajectory = trajectory
        self.length = length
        self.control_size = control_size
        self.dropped: Counter[str] = Counter()
        self._epoch: str | None = None
        self._retired: deque[str] = deque(maxlen=RETIRED_EPOCHS)
        self._begin()

    def _begin(self) -> None:
        self._pending: dict[int, Shot] = {}  # out of order
        self._next = 0
        self._count = 0
        self._ordered: deque[_Ordered] = deque()  # in order, waiting for their controls
        self._last_format = ""
        self._controls: dict[int, np.ndarray] = {}
        self._run: list[Shot] = []
        self._run_controls: list[np.ndarray] = []
        self._run_seq = 0

    def add_frame(self, epoch: str, seq: int, shot: Shot) -> list[Segment]:
        """Take a frame in; the segments that it completes."""
        if not self._enter(epoch):
            self.dropped[STALE] += 1
        elif seq < self._next or seq in self._pending:
            self.dropped[LATE] += 1
        else:
            self._pending[seq] = shot
            self._order()
        return self._emit()

    def add_control(self, epoch: str, seq: int, u: np.ndarray) -> list[Segment]:
        """Take control `seq` (p,) in; the segments that it completes. A late one changes nothing.

        Of controls ahead of the frames the lowest 80 are kept.
        """
        if self._enter(epoch) and self._needs(seq):
            self._controls[seq] = u
            if len(self._controls) > _EARLY_CONTROLS:
                del self._controls[max(self._controls)]
        return self._emit()

    def finish(self) -> None:
        """Drop what is held: no more will come."""
        self._drop_held(END)

    def _enter(self, epoch: str) -> bool:
        """Turn to a new epoch, if it is one; False for one that is over."""
        if epoch in self._retired:
            return False
        if self._epoch not in (None, epoch):
            self._retired.append(str(self._epoch))
            self._drop_held(NEW_EPOCH)
        self._epoch = epoch
        return True

    def _drop_held(self, why: str) -> None:
        held = len(self._pending) + len(self._ordered) + len(self._run)
        if held:
            self.dropped[why] += held
        self._begin()

    def _order(self) -> None:
        """Move the frames whose turn has come out of `_pending`, past gaps that stay."""
        while self._next in self._pending or len(self._pending) > REORDER_LIMIT:
            seq = min(self._pending)
            shot = self._pending.pop(seq)
            broken = GAP if seq != self._next else ""
            if not broken and shot.format != self._last_format:
                broken = CHANGED
            self._count += 1
            self._ordered.append(_Ordered(seq, shot, broken, self._count))
            self._next, self._last_format = seq + 1, shot.format

    def _needs(self, seq: int) -> bool:
        return seq + 1 >= self._next or any(frame.seq == seq + 1 for frame in self._ordered)

    def _emit(self) -> list[Segment]:
        """Take off the frames whose control has come, is not needed or is given up."""
        segments = []
        while self._ordered:
            frame = self._ordered[0]
            broken = frame.broken
            if not broken and self.control_size and frame.seq - 1 not in self._controls:
                if self._count - frame.place <= REORDER_LIMIT:
                    break
                broken = NO_CONTROL
            self._ordered.popleft()
            segments += self._extend(frame, broken)
        self._controls = {k: u for k, u in self._controls.items() if self._needs(k)}
        return segments

    def _extend(self, frame: _Ordered, broken: str) -> list[Segment]:
        if broken and self._run:
            self.dropped[broken] += len(self._run)
            self._run, self._run_controls = [], []
        if not self._run:
            self._run_seq = frame.seq
        else:
            self._run_controls.append(self._controls.get(frame.seq - 1, np.zeros(0)))
        self._run.append(frame.shot)
        return [self._cut()] if len(self._run) == self.length else []

    def _cut(self) -> Segment:
        segment = Segment(
            self.trajectory,
            str(self._epoch),
            self._run_seq,
            np.stack([shot.image for shot in self._run]),
            np.array(self._run_controls).reshape(self.length - 1, self.control_size),
            np.array([shot.time for shot in self._run]),
        )
        self._run, self._run_controls = [], []
        return segment
