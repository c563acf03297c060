"""The stream of one trajectory as a deterministic fold over (epoch, number).

A source's stream is an epoch (a random id chosen at its start) and numbers from 0; control k acts
between frames k and k+1. The fold joins them by number, never by arrival, into the transitions
(w_k, z_{k+1}) that the estimator learns from, in the order of k. Reordering is undone within
`reorder_limit`; what is missing beyond it is given up and counted. The result is exact:

- Frame s is folded unless more than `reorder_limit` higher frames came before it.
- Transition k exists when frames k-h+1 ... k+1 were folded; it never straddles a gap.
- It is emitted unless control k had not come when the `reorder_limit + 1`-th frame after k+1 was
  folded.

Memory is bounded whatever comes.
"""

from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from koop_service.estimation.settings import EstimatorSettings

Array = NDArray[np.float64]

#: Epochs that are remembered as over; a message of theirs is refused.
RETIRED_EPOCHS = 8
#: Controls that may wait for their frames, per frame that may.
CONTROLS_PER_PENDING_FRAME = 8

#: frames and controls: taken. duplicates, late, stale_epoch: refused. gaps, missing_frames,
#: missing_controls: given up. late_join: epochs whose first frame was not number 0.
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
    """What the fold would do with a message; only the first two are worth encoding."""

    ACCEPTED = "accepted"
    NEW_EPOCH = "new_epoch"
    DUPLICATE = "duplicate"
    LATE = "late"
    STALE_EPOCH = "stale_epoch"

    @property
    def welcome(self) -> bool:
        """Whether the message would be folded."""
        return self in (Admission.ACCEPTED, Admission.NEW_EPOCH)


_COUNTED_AS = {
    Admission.DUPLICATE: "duplicates",
    Admission.LATE: "late",
    Admission.STALE_EPOCH: "stale_epoch",
}


@dataclass(frozen=True, eq=False, slots=True)
class Transition:
    """A measurement of the model: regressor w (d,) at frame `seq`, next code y (n,)."""

    w: Array
    y: Array
    seq: int


class _Window(NamedTuple):
    """Codes (h+1, n) of frames seq-h+1 ... seq+1, waiting for control `seq`."""

    seq: int
    codes: Array
    folded: int  # frames folded in this epoch when the window was complete


class Stream:
    """The fold's state. Messages go in, transitions come out; no clock, no log, no I/O."""

    def __init__(self, settings: EstimatorSettings, reorder_limit: int = 8) -> None:
        """reorder_limit: frames that may wait for a missing one. ValueError below 0."""
        if reorder_limit < 0:
            raise ValueError(f"reorder_limit is {reorder_limit}; expected 0 frames or more")
        self.settings = settings
        self.reorder_limit = reorder_limit
        self.counters = dict.fromkeys(COUNTERS, 0)
        self._retired: deque[str] = deque(maxlen=RETIRED_EPOCHS)
        self._begin(None)

    def _begin(self, epoch: str | None) -> None:
        self.epoch = epoch
        self.next_seq = 0
        self.frames = 0  # folded in this epoch
        self._run_start: int | None = None  # first frame since the last gap
        self._run: deque[Array] = deque(maxlen=self.settings.history + 1)
        self._pending: dict[int, Array] = {}
        self._windows: deque[_Window] = deque()
        self._controls: dict[int, Array] = {}
        self._spent: tuple[int, Array] | None = None  # highest control no longer needed

    # What the caller may ask

    @property
    def history(self) -> Array | None:
        """The newest codes (h, n), oldest first, or None while they are not contiguous."""
        h = self.settings.history
        return np.array(list(self._run)[-h:]) if len(self._run) >= h else None

    @property
    def last_control(self) -> tuple[int, Array] | None:
        """Number and value (p,) of the newest control up to the newest folded frame, or None."""
        known = [(seq, u) for seq, u in self._controls.items() if seq < self.next_seq]
        if self._spent is not None:
            known.append(self._spent)
        return max(known, key=lambda item: item[0], default=None)

    @property
    def missing(self) -> tuple[int, int] | None:
        """Frames [start, stop) that later ones wait for: what to ask a source to replay."""
        return (self.next_seq, min(self._pending)) if self._pending else None

    @property
    def replay_from(self) -> int:
        """Lowest number whose frame or control can still change the fold."""
        return self._windows[0].seq if self._windows else max(self.next_seq - 1, 0)

    # Folding

    def admit_frame(self, epoch: str, seq: int) -> Admission:
        """What `fold_frame` would do now. A refusal is counted here, so do not fold it as well.

        Nothing else changes: an epoch turns over when its first message is folded. The caller
        resets the estimator when `epoch` has changed across a fold.
        """
        admission = self._admission(epoch, seq, self._judge_frame)
        self._count_refusal(admission)
        return admission

    def fold_frame(self, epoch: str, seq: int, code: Array) -> list[Transition]:
        """Fold the code (n,) of frame `seq`; the transitions that this completes, in order.

        Raises ValueError for a code of the wrong shape, NaN or infinity, and a negative number.
        """
        code = _checked("code", code, self.settings.code_size, seq)
        admission = self.admit_frame(epoch, seq)
        if not admission.welcome:
            return []
        self._turn_over(epoch)
        self._pending[seq] = code
        return self._drain()

    def fold_control(self, epoch: str, seq: int, u: Array) -> list[Transition]:
        """Fold control `seq` (p,); errors as in `fold_frame`. Not for unforced streams (p = 0)."""
        u = _checked("control", u, self.settings.control_size, seq)
        admission = self._admission(epoch, seq, self._judge_control)
        self._count_refusal(admission)
        if not admission.welcome:
            return []
        self._turn_over(epoch)
        self._store_control(seq, u)
        return self._emit()

    def _admission(self, epoch: str, seq: int, judge: "_Judge") -> Admission:
        if epoch in self._retired:
            return Admission.STALE_EPOCH
        return judge(seq) if epoch == self.epoch else Admission.NEW_EPOCH

    def _judge_frame(self, seq: int) -> Admission:
        if seq >= self.next_seq:
            return Admission.DUPLICATE if seq in self._pending else Admission.ACCEPTED
        # Every frame since the last gap was folded; before it, nobody remembers which.
        folded = self._run_start is not None and seq >= self._run_start
        return Admission.DUPLICATE if folded else Admission.LATE

    def _judge_control(self, seq: int) -> Admission:
        if seq in self._controls:
            return Admission.DUPLICATE
        return Admission.ACCEPTED if self._needs_control(seq) else Admission.LATE

    def _needs_control(self, seq: int) -> bool:
        return seq + 1 >= self.next_seq or any(window.seq == seq for window in self._windows)

    def _count_refusal(self, admission: Admission) -> None:
        if not admission.welcome:
            self.counters[_COUNTED_AS[admission]] += 1

    def _turn_over(self, epoch: str) -> None:
        if epoch == self.epoch:
            return
        if self.epoch is not None:
            self._retired.append(self.epoch)
        self._begin(epoch)

    def _drain(self) -> list[Transition]:
        """Fold every pending frame whose turn has come."""
        transitions: list[Transition] = []
        while self._pending:
            if self.next_seq not in self._pending:
                if len(self._pending) <= self.reorder_limit:
                    break
                self._skip_to(min(self._pending))
            self._advance(self._pending.pop(self.next_seq))
            transitions += self._emit()
        return transitions

    def _skip_to(self, seq: int) -> None:
        """Give up the frames before `seq`: the history starts again there."""
        if self._run_start is None:
            self.counters["late_join"] += 1
        else:
            self.counters["gaps"] += 1
            self.counters["missing_frames"] += seq - self.next_seq
        self._run.clear()
        self._run_start = None
        self.next_seq = seq

    def _advance(self, code: Array) -> None:
        """Fold the code of frame `next_seq`."""
        if self._run_start is None:
            self._run_start = self.next_seq
        self._run.append(code)
        self.next_seq += 1
        self.frames += 1
        self.counters["frames"] += 1
        if len(self._run) > self.settings.history:
            self._windows.append(_Window(self.next_seq - 2, np.array(self._run), self.frames))
        self._forget_controls()

    def _emit(self) -> list[Transition]:
        """Take the windows whose control has come or is given up, oldest first."""
        transitions: list[Transition] = []
        while self._windows:
            window = self._windows[0]
            if self.settings.control_size and window.seq not in self._controls:
                if self.frames - window.folded <= self.reorder_limit:
                    break
                self.counters["missing_controls"] += 1
            else:
                transitions.append(self._transition(window))
            self._windows.popleft()
            self._forget_controls()
        return transitions

    def _transition(self, window: _Window) -> Transition:
        h, d = self.settings.history, self.settings.regressor_size
        w = np.ones(d)  # the last entry stays 1 when affine
        hn = h * self.settings.code_size
        w[:hn] = window.codes[:h].reshape(-1)
        if self.settings.control_size:
            w[hn : hn + self.settings.control_size] = self._controls[window.seq]
        return Transition(w, window.codes[h], window.seq)

    def _store_control(self, seq: int, u: Array) -> None:
        """Keep it; where too many wait, the one furthest ahead goes: it is the least likely used."""
        self.counters["controls"] += 1
        self._controls[seq] = u
        if len(self._controls) > CONTROLS_PER_PENDING_FRAME * (self.reorder_limit + 2):
            del self._controls[max(self._controls)]

    def _forget_controls(self) -> None:
        """Drop the controls that no window, present or future, can ask for."""
        for seq in [seq for seq in self._controls if not self._needs_control(seq)]:
            u = self._controls.pop(seq)
            if self._spent is None or seq > self._spent[0]:
                self._spent = (seq, u)
