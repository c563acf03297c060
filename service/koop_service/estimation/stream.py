"""The stream of one trajectory as a deterministic fold over (epoch, number).

A source's stream is an epoch (a random id chosen at its start) and numbers from 0. The fold joins
frames and controls by number, never by arrival, into the transitions (w_k, z_{k+1}) that the
estimator learns from, in the order of k. What it does is exact:

- Frame s is folded unless more than `reorder_limit` higher frames came before it.
- Transition k exists when frames k-h+1 ... k+1 were folded; it never straddles a gap.
- It is emitted once, unless control k had not come when `reorder_limit` + 1 frames after frame k+1
  were folded.

So any interleaving within the limit gives the same transitions. Memory is bounded whatever comes.
"""

from collections import deque
from enum import StrEnum
from typing import Any

import numpy as np

from .compiled import Array
from .join import ControlJoin, Transition
from .reorder import FrameOrder, OrderedFrame
from .restoring import texts, whole
from .settings import EstimatorSettings

__all__ = ["COUNTERS", "Admission", "Stream", "Transition"]

#: Epochs remembered as over; a message of theirs is refused.
RETIRED_EPOCHS = 8

#: Taken: frames (folded), controls. Refused: duplicates, late (given up, or of no use any more),
#: stale_epoch. Given up: gaps (and the missing_frames in them), missing_controls.
#: late_join: epochs that did not start with frame 0.
COUNTERS = (
    "frames",
    "controls",
    "duplicates",
    "late",
    "gaps",
    "missing_frames",
    "missing_controls",
    "stale_epoch",
    "late_join",
)


class Admission(StrEnum):
    """What the fold makes of a message."""

    ACCEPTED = "accepted"
    NEW_EPOCH = "new_epoch"
    DUPLICATE = "duplicate"
    LATE = "late"
    STALE_EPOCH = "stale_epoch"

    @property
    def welcome(self) -> bool:
        """Whether the message is folded, so worth encoding."""
        return self in (Admission.ACCEPTED, Admission.NEW_EPOCH)


_REFUSALS = {
    Admission.DUPLICATE: "duplicates",
    Admission.LATE: "late",
    Admission.STALE_EPOCH: "stale_epoch",
}


class Stream:
    """The fold's state. Messages go in, transitions come out; no clock, no log, no I/O.

    settings: the estimator's sizes. reorder_limit: frames that may wait for a missing one, 0 or
    more (else ValueError). counters: see COUNTERS; they count over all epochs.
    """

    def __init__(self, settings: EstimatorSettings, reorder_limit: int = 8) -> None:
        if reorder_limit < 0:
            raise ValueError(f"reorder_limit is {reorder_limit}; expected 0 frames or more")
        self.settings = settings
        self.reorder_limit = reorder_limit
        self.counters: dict[str, int] = dict.fromkeys(COUNTERS, 0)
        self.epoch: str | None = None
        self._retired: deque[str] = deque(maxlen=RETIRED_EPOCHS)
        self._order = FrameOrder(reorder_limit)
        self._join = ControlJoin(settings, reorder_limit)

    @property
    def retired(self) -> tuple[str, ...]:
        """The epochs that are over, oldest first, the last 8."""
        return tuple(self._retired)

    @property
    def next_seq(self) -> int:
        """The number of the next frame to fold: one more than the newest folded frame's."""
        return self._order.next_seq

    @property
    def frames(self) -> int:
        """Frames folded in this epoch."""
        return self._join.frames

    @property
    def history(self) -> Array | None:
        """Codes (h, n) of frames next_seq-h ... next_seq-1, or None while a gap is among them."""
        return self._join.history

    @property
    def last_control(self) -> tuple[int, Array] | None:
        """Number and value (p,) of the newest control up to the newest folded frame, or None."""
        return self._join.last_control

    @property
    def missing(self) -> tuple[int, int] | None:
        """Frames [start, stop) that later ones wait for, or None: what to ask a source for."""
        return self._order.missing

    @property
    def replay_from(self) -> int:
        """Lowest number whose frame or control can still change the fold: replay from there."""
        return self._join.first_needed

    def knows_frame(self, seq: int) -> bool:
        """Whether frame `seq` of this epoch came already, or its turn has passed."""
        return self._order.is_duplicate(seq) or self._order.is_late(seq)

    def knows_control(self, seq: int) -> bool:
        """Whether control `seq` of this epoch came already, or is of no use any more."""
        return self._join.has_control(seq) or not self._join.needs_control(seq)

    def lacks(self, seq: int) -> int | None:
        """What is missing before frame `seq` of this epoch: a frame, or a control given up with it.

        None if nothing is; else the number of a frame that its source puts after all of that. A
        record of the source's puts that reaches this frame, and was folded, has none of it.
        """
        order = self._order
        gap, control = order.gap_before(seq), self._join.gives_up(1 + order.waiting, order.row(seq))
        later = [] if gap is None else [gap]
        return max(later + ([] if control is None else [control + 1]), default=None)

    def admit_frame(self, epoch: str, seq: int) -> Admission:
        """What `fold_frame` would make of this frame now, to ask before encoding it.

        A refusal is counted here, so a refused frame need not be folded. Nothing else changes: an
        epoch turns over when its first message is *folded*; reset the estimator whenever `epoch`
        differs after a fold.
        """
        if epoch != self.epoch:
            return self._count(self._admit_epoch(epoch))
        if self._order.is_duplicate(seq):
            return self._count(Admission.DUPLICATE)
        return self._count(Admission.LATE if self._order.is_late(seq) else Admission.ACCEPTED)

    def fold_frame(self, epoch: str, seq: int, code: Array) -> list[Transition]:
        """Fold the code (n,) of frame `seq`; the transitions that it completes, in order.

        Raises ValueError for a wrong shape, NaN, infinity or a negative number.
        """
        code = _checked("code", code, self.settings.code_size, seq)
        if not self.admit_frame(epoch, seq).welcome:
            return []
        self._turn_over(epoch)
        self._order.add(seq, code)
        transitions: list[Transition] = []
        while (frame := self._order.pop()) is not None:
            self._count_frame(frame)
            transitions += self._join.add_frame(frame.seq, frame.code)
        return self._counted(transitions)

    def fold_control(self, epoch: str, seq: int, u: Array) -> list[Transition]:
        """Fold control `seq` (p,), which acted between frames seq and seq+1; as `fold_frame`."""
        u = _checked("control", u, self.settings.control_size, seq)
        if not self._admit_control(epoch, seq).welcome:
            return []
        self._turn_over(epoch)
        self.counters["controls"] += 1
        return self._counted(self._join.add_control(seq, u))

    def _admit_control(self, epoch: str, seq: int) -> Admission:
        if epoch != self.epoch:
            return self._count(self._admit_epoch(epoch))
        if self._join.has_control(seq):
            return self._count(Admission.DUPLICATE)
        needed = self._join.needs_control(seq)
        return self._count(Admission.ACCEPTED if needed else Admission.LATE)

    def _admit_epoch(self, epoch: str) -> Admission:
        return Admission.STALE_EPOCH if epoch in self._retired else Admission.NEW_EPOCH

    def _turn_over(self, epoch: str) -> None:
        if epoch == self.epoch:
            return
        if self.epoch is not None:
            self._retired.append(self.epoch)
        self.epoch = epoch
        self._order = FrameOrder(self.reorder_limit)
        self._join = ControlJoin(self.settings, self.reorder_limit)

    def _count(self, admission: Admission) -> Admission:
        if admission in _REFUSALS:
            self.counters[_REFUSALS[admission]] += 1
        return admission

    def _count_frame(self, frame: OrderedFrame) -> None:
        self.counters["frames"] += 1
        if frame.skipped and self.frames == 0:
            self.counters["late_join"] += 1
        elif frame.skipped:
            self.counters["gaps"] += 1
            self.counters["missing_frames"] += frame.skipped

    def _counted(self, transitions: list[Transition]) -> list[Transition]:
        self.counters["missing_controls"] += self._join.given_up
        self._join.given_up = 0
        return transitions

    def snapshot(self) -> dict[str, Any]:
        """A plain dict of numbers, strings, lists and arrays that `restore` continues from."""
        return {
            "sizes": _sizes(self.settings),
            "reorder_limit": self.reorder_limit,
            "epoch": self.epoch,
            "retired": list(self._retired),
            "counters": dict(self.counters),
            "order": self._order.snapshot(),
            "join": self._join.snapshot(),
        }

    @classmethod
    def restore(cls, settings: EstimatorSettings, snapshot: dict[str, Any]) -> "Stream":
        """The stream that `snapshot` was taken of.

        Raises ValueError, KeyError or TypeError when its sizes are others or it is damaged.
        """
        if list(snapshot["sizes"]) != _sizes(settings):
            raise ValueError(
                f"snapshot has sizes (n, h, p) = {snapshot['sizes']}; expected {_sizes(settings)}:"
                " it belongs to another model"
            )
        stream = cls(settings, whole("reorder_limit", snapshot["reorder_limit"]))
        epochs = [] if snapshot["epoch"] is None else [snapshot["epoch"]]
        stream.epoch = next(iter(texts("epoch", epochs)), None)
        stream._retired.extend(texts("retired", snapshot["retired"]))
        counters = {**stream.counters, **snapshot["counters"]}
        stream.counters = {name: whole(name, counters[name]) for name in stream.counters}
        stream._order.restore(snapshot["order"], settings.code_size)
        stream._join.restore(snapshot["join"])
        if snapshot["order"]["next_seq"] != snapshot["join"]["next_seq"]:
            raise ValueError("the snapshot's frames and controls are of different moments")
        return stream


def _sizes(settings: EstimatorSettings) -> list[int]:
    return [settings.code_size, settings.history, settings.control_size]


def _checked(name: str, vector: Array, size: int, seq: int) -> Array:
    """A private float64 copy: what is kept must not change under the caller's hands."""
    if seq < 0:
        raise ValueError(f"{name} has number {seq}; expected 0 or more")
    vector = np.array(vector, dtype=np.float64)
    if vector.shape != (size,):
        raise ValueError(f"{name} {seq} has shape {vector.shape}; expected ({size},)")
    if not np.isfinite(vector).all():
        raise ValueError(f"{name} {seq} has NaN or infinity; expected finite numbers")
    return vector
