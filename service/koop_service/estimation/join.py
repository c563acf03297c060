"""Ordered codes joined with controls, by number, into the transitions that a model is learned from.

Control k acts between frames k and k+1, so transition k is the window of codes k-h+1 ... k+1 with
control k. A window waits for its control; those behind it wait too, since the order matters to an
estimator that forgets.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .compiled import Array
from .restoring import vectors, whole, wholes
from .settings import EstimatorSettings

#: Controls that may be ahead of the frames, per frame that may be waiting.
EARLY_CONTROLS_PER_FRAME = 8


@dataclass(frozen=True, eq=False, slots=True)
class Transition:
    """A measurement of the model: regressor w (d,) at frame `seq`, and the next code y (n,)."""

    w: Array
    y: Array
    seq: int


class _Window(NamedTuple):
    """Codes (h+1, n) of frames seq-h+1 ... seq+1; `folded` counts the frames up to the last one."""

    seq: int
    codes: Array
    folded: int


class ControlJoin:
    """Windows and controls that still wait for each other; both bounded.

    A control is given up when `limit` + 1 frames were folded after the one it leads to. Of controls
    ahead of the frames the lowest 8 (limit + 2) are kept.
    """

    def __init__(self, settings: EstimatorSettings, limit: int) -> None:
        self.frames = 0
        self.given_up = 0  # transitions lost because their control never came
        self._settings = settings
        self._limit = limit
        self._most_controls = EARLY_CONTROLS_PER_FRAME * (limit + 2)
        self._next_seq = 0
        self._run: deque[Array] = deque(maxlen=settings.history + 1)
        self._windows: deque[_Window] = deque()
        self._controls: dict[int, Array] = {}
        self._spent: tuple[int, Array] | None = None  # the highest control no longer needed

    @property
    def history(self) -> Array | None:
        """The newest codes (h, n), oldest first, or None while they are not contiguous."""
        h = self._settings.history
        return np.array(list(self._run)[-h:]) if len(self._run) >= h else None

    @property
    def last_control(self) -> tuple[int, Array] | None:
        """Number and value (p,) of the newest control up to the newest frame, or None."""
        known = [(seq, u) for seq, u in self._controls.items() if seq < self._next_seq]
        if self._spent is not None:
            known.append(self._spent)
        return max(known, key=lambda item: item[0], default=None)

    @property
    def first_needed(self) -> int:
        """Lowest number whose control can still change anything."""
        return self._windows[0].seq if self._windows else max(self._next_seq - 1, 0)

    def has_control(self, seq: int) -> bool:
        """Whether control `seq` came and is still needed."""
        return seq in self._controls

    def needs_control(self, seq: int) -> bool:
        """Whether a window, present or future, can ask for control `seq`."""
        return seq + 1 >= self._next_seq or any(window.seq == seq for window in self._windows)

    def gives_up(self, frames: int, row: int) -> int | None:
        """Highest control that has not come, and would be too late after `frames` more frames.

        A window waits for its control. A run's first controls have none: their turn is over with
        the next frame, and all that they change is the count of controls. `row`: how many of the
        frames are the next ones, without a gap.
        """
        run, h = len(self._run), self._settings.history
        if self._settings.control_size == 0 or (run >= h and not self._windows):
            return None  # as nearly always
        late = [w.seq for w in self._windows if self.frames + frames - w.folded > self._limit]
        late += [self._next_seq - 2 + j for j in range(max(1, 2 - run), 1 + min(row, h - run))]
        return max((seq for seq in late if seq not in self._controls), default=None)

    def add_control(self, seq: int, u: Array) -> list[Transition]:
        """Take a needed control (p,); the transitions that it completes."""
        self._controls[seq] = u
        if len(self._controls) > self._most_controls:
            # The one furthest ahead is the least likely ever to be used.
            del self._controls[max(self._controls)]
        return self._emit()

    def add_frame(self, seq: int, code: Array) -> list[Transition]:
        """Take the next code (n,) in order; the transitions that it completes or stops blocking."""
        if seq != self._next_seq:
            self._run.clear()
        self._run.append(code)
        self._next_seq = seq + 1
        self.frames += 1
        if len(self._run) > self._settings.history:
            self._windows.append(_Window(seq - 1, np.array(self._run), self.frames))
        return self._emit()

    def _emit(self) -> list[Transition]:
        """Take off the windows whose control has come or is given up, oldest first."""
        transitions: list[Transition] = []
        while self._windows:
            window = self._windows[0]
            if self._settings.control_size == 0 or window.seq in self._controls:
                transitions.append(self._transition(window))
            elif self.frames - window.folded > self._limit:
                self.given_up += 1
            else:
                break
            self._windows.popleft()
        self._forget_controls()
        return transitions

    def _transition(self, window: _Window) -> Transition:
        n, h, p = self._settings.code_size, self._settings.history, self._settings.control_size
        w = np.ones(self._settings.regressor_size)  # the last entry stays 1 when affine
        w[: h * n] = window.codes[:h].reshape(-1)
        if p:
            w[h * n : h * n + p] = self._controls[window.seq]
        return Transition(w, window.codes[h], window.seq)

    def _forget_controls(self) -> None:
        for seq in [seq for seq in self._controls if not self.needs_control(seq)]:
            u = self._controls.pop(seq)
            if self._spent is None or seq > self._spent[0]:
                self._spent = (seq, u)

    def snapshot(self) -> dict[str, Any]:
        """Plain numbers, lists and arrays; `restore` continues alike."""
        spent = [] if self._spent is None else [self._spent]
        return {
            "frames": self.frames,
            "given_up": self.given_up,
            "next_seq": self._next_seq,
            "run": [code.copy() for code in self._run],
            "window_seqs": [window.seq for window in self._windows],
            "window_codes": [window.codes.copy() for window in self._windows],
            "window_folded": [window.folded for window in self._windows],
            "control_seqs": list(self._controls),
            "controls": [u.copy() for u in self._controls.values()],
            "spent_seqs": [seq for seq, _ in spent],
            "spent_controls": [u.copy() for _, u in spent],
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Become what `snapshot` was taken of; ValueError where it is damaged."""
        n, h, p = self._settings.code_size, self._settings.history, self._settings.control_size
        self.frames = whole("frames", snapshot["frames"])
        self.given_up = whole("given_up", snapshot["given_up"])
        self._next_seq = whole("next_seq", snapshot["next_seq"])
        self._run.clear()
        self._run.extend(vectors("run", snapshot["run"], n))
        seqs = wholes("window_seqs", snapshot["window_seqs"], self._limit + 1)
        codes = vectors("window_codes", snapshot["window_codes"], h + 1, n)
        folded = wholes("window_folded", snapshot["window_folded"], self._limit + 1)
        if seqs != sorted(seqs) or folded != sorted(folded) or max(folded, default=0) > self.frames:
            raise ValueError("the snapshot's windows are not in order, or not folded yet")
        self._windows = deque(_Window(*w) for w in zip(seqs, codes, folded, strict=True))
        known = wholes("control_seqs", snapshot["control_seqs"], self._most_controls)
        controls = vectors("controls", snapshot["controls"], p)
        self._controls = dict(zip(known, controls, strict=True))
        spent = wholes("spent_seqs", snapshot["spent_seqs"], 1)
        values = vectors("spent_controls", snapshot["spent_controls"], p)
        self._spent = next(zip(spent, values, strict=True), None)
