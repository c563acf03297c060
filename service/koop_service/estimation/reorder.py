"""Frames put back in the order of their numbers, with the gaps that cannot be filled."""

from dataclasses import dataclass
from typing import Any

from .compiled import Array
from .restoring import vectors, whole, wholes


@dataclass(frozen=True, eq=False, slots=True)
class OrderedFrame:
    """The next frame in order: its code (n,), and how many numbers before it were given up."""

    seq: int
    code: Array
    skipped: int


class FrameOrder:
    """A reorder buffer: up to `limit` frames wait for a missing one; one more, and it is given up.

    So frame s passes unless more than `limit` higher ones came before it, whatever else happened.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.next_seq = 0
        self.run_start = 0  # every number from here to next_seq passed
        self._pending: dict[int, Array] = {}

    @property
    def missing(self) -> tuple[int, int] | None:
        """Numbers [start, stop) that the waiting frames wait for, or None."""
        return (self.next_seq, min(self._pending)) if self._pending else None

    def is_duplicate(self, seq: int) -> bool:
        """Whether the frame certainly came before. Before the last gap nobody remembers."""
        return self.run_start <= seq < self.next_seq or seq in self._pending

    def is_late(self, seq: int) -> bool:
        """Whether its turn is over, and it was given up or is before the last gap."""
        return seq < self.run_start

    def gap_before(self, seq: int) -> int | None:
        """With frame `seq` too: the lowest that waits for a missing one, or None."""
        return None if seq == self.next_seq else min((seq, *self._pending))

    def row(self, seq: int) -> int:
        """With frame `seq` too: how many can pass at once, without a gap."""
        end = self.next_seq
        while end == seq or end in self._pending:
            end += 1
        return end - self.next_seq

    @property
    def waiting(self) -> int:
        """Frames that wait for a missing one."""
        return len(self._pending)

    def add(self, seq: int, code: Array) -> None:
        """Put a frame in that is neither late nor a duplicate."""
        self._pending[seq] = code

    def pop(self) -> OrderedFrame | None:
        """The next frame in order, if its turn has come."""
        seq = self.next_seq
        if seq not in self._pending:
            if len(self._pending) <= self.limit:
                return None
            seq = self.run_start = min(self._pending)
        skipped = seq - self.next_seq
        self.next_seq = seq + 1
        return OrderedFrame(seq, self._pending.pop(seq), skipped)

    def snapshot(self) -> dict[str, Any]:
        """Plain numbers, lists and arrays; `restore` continues alike."""
        return {
            "next_seq": self.next_seq,
            "run_start": self.run_start,
            "pending_seqs": list(self._pending),
            "pending_codes": [code.copy() for code in self._pending.values()],
        }

    def restore(self, snapshot: dict[str, Any], code_size: int) -> None:
        """Become what `snapshot` was taken of; ValueError where it is damaged."""
        self.next_seq = whole("next_seq", snapshot["next_seq"])
        self.run_start = whole("run_start", snapshot["run_start"])
        waiting = wholes("pending_seqs", snapshot["pending_seqs"], self.limit)
        codes = vectors("pending_codes", snapshot["pending_codes"], code_size)
        self._pending = dict(zip(waiting, codes, strict=True))
        if min(waiting, default=self.next_seq) < self.next_seq or self.run_start > self.next_seq:
            raise ValueError(f"the snapshot's frames wait behind frame {self.next_seq}")
