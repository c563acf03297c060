"""The fold over (epoch, number) said as plainly as can be: an oracle for `stream.Stream`.

It keeps everything that ever came in the epoch, and asks the definitions in the stream's docstring
of it anew at each message. It is slow, its memory grows, and it shares no code with what it judges.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np


class Emitted(NamedTuple):
    """A transition: its number, regressor w and next code y."""

    seq: int
    w: np.ndarray
    y: np.ndarray


class SimpleFold:
    """history h, control_size p, affine, limit: as of the stream's settings."""

    def __init__(self, history: int, control_size: int, affine: bool, limit: int) -> None:
        self.h, self.p, self.affine, self.limit = history, control_size, affine, limit
        self.counters: Counter[str] = Counter()
        self.retired: list[str] = []
        self.epoch: str | None = None
        self._begin()

    def _begin(self) -> None:
        self.frames: dict[int, np.ndarray] = {}
        self.controls: dict[int, np.ndarray] = {}
        self.folded: list[int] = []
        self.windows: list[tuple[int, int]] = []  # (number, frames folded when it came to be)

    # Messages

    def fold_frame(self, epoch: str, seq: int, code: np.ndarray) -> list[Emitted]:
        if not self._enters(epoch):
            return []
        if seq < self._last_gap() or self._is_given_up(seq):
            self.counters["late"] += 1
            return []
        if seq in self.frames:
            self.counters["duplicates"] += 1
            return []
        self.frames[seq] = code
        emitted: list[Emitted] = []
        while (first := self._next_in_order()) is not None:
            self._fold(first)
            emitted += self._emit()
        return emitted

    def fold_control(self, epoch: str, seq: int, u: np.ndarray) -> list[Emitted]:
        if not self._enters(epoch):
            return []
        if not self._needs(seq):
            self.counters["late"] += 1
            return []
        if seq in self.controls:
            self.counters["duplicates"] += 1
            return []
        self.counters["controls"] += 1
        self.controls[seq] = u
        needed = [number for number in self.controls if self._needs(number)]
        if len(needed) > 8 * (self.limit + 2):
            del self.controls[max(needed)]
        return self._emit()

    def _enters(self, epoch: str) -> bool:
        """Whether the message is of the present epoch, or begins a new one."""
        if epoch != self.epoch:
            if epoch in self.retired[-8:]:
                self.counters["stale_epoch"] += 1
                return False
            if self.epoch is not None:
                self.retired.append(self.epoch)
            self.epoch = epoch
            self._begin()
        return True

    # Order

    @property
    def next_seq(self) -> int:
        return self.folded[-1] + 1 if self.folded else 0

    def _is_given_up(self, seq: int) -> bool:
        """More than `limit` higher frames came before it."""
        return seq not in self.frames and sum(other > seq for other in self.frames) > self.limit

    def _last_gap(self) -> int:
        """The number after the last one that was skipped; 0 where none was."""
        folded = set(self.folded)
        return max((n for n in self.folded if n and n - 1 not in folded), default=0)

    def _waiting(self) -> list[int]:
        return sorted(set(self.frames) - set(self.folded))

    def _next_in_order(self) -> int | None:
        """The lowest frame that waits, once no lower one can come any more."""
        waiting = self._waiting()
        if not waiting:
            return None
        first = waiting[0]
        return first if first == self.next_seq or self._is_given_up(first - 1) else None

    def _fold(self, seq: int) -> None:
        skipped = seq - self.next_seq
        if skipped:
            self.counters["gaps" if self.folded else "late_join"] += 1
            self.counters["missing_frames"] += skipped if self.folded else 0
        self.counters["frames"] += 1
        self.folded.append(seq)
        if set(range(seq - self.h, seq + 1)) <= set(self.folded):
            self.windows.append((seq - 1, len(self.folded)))

    # Join

    def _needs(self, seq: int) -> bool:
        return seq + 1 >= self.next_seq or any(seq == number for number, _ in self.windows)

    def _emit(self) -> list[Emitted]:
        emitted: list[Emitted] = []
        while self.windows:
            number, since = self.windows[0]
            if self.p == 0 or number in self.controls:
                emitted.append(self._transition(number))
            elif len(self.folded) - since > self.limit:
                self.counters["missing_controls"] += 1
            else:
                break
            self.windows.pop(0)
        return emitted

    def _transition(self, k: int) -> Emitted:
        codes = [self.frames[n] for n in range(k - self.h + 1, k + 1)]
        controls = [self.controls[k]] if self.p else []
        w = np.concatenate([*codes, *controls, [1.0] * self.affine])
        return Emitted(k, w, self.frames[k + 1])

    # What is known

    @property
    def history(self) -> np.ndarray | None:
        newest = range(self.next_seq - self.h, self.next_seq)
        return (
            np.array([self.frames[n] for n in newest]) if set(newest) <= set(self.folded) else None
        )

    @property
    def last_control(self) -> tuple[int, np.ndarray] | None:
        known = [seq for seq in self.controls if seq < self.next_seq]
        return (max(known), self.controls[max(known)]) if known else None

    @property
    def missing(self) -> tuple[int, int] | None:
        waiting = self._waiting()
        return (self.next_seq, waiting[0]) if waiting else None

    @property
    def replay_from(self) -> int:
        return self.windows[0][0] if self.windows else max(self.next_seq - 1, 0)
