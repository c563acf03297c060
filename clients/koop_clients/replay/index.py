"""Where the messages of a log are: all that is known of each but its bytes. Pure.

It is kept in memory and built anew when a file is opened. In the file it would be a second tree, in
which the messages of a moment are scattered over as many pages as there are trajectories, and would
cost each append and each deletion as much as the message itself.

A message takes 21 bytes, in arrays: none of it is an object, so that Python's garbage collector has
a few things to visit for each trajectory, however many messages there are.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from heapq import merge

from koop_protocol import MAX_BATCH, ReplayQuery

FRAME, CONTROL = 0, 1

Mark = tuple[int, int, int]
"""Of one message: position, size in bytes, number of its trajectory."""


@dataclass(frozen=True)
class Batch:
    """What one reply holds.

    Attributes:
        positions: of the messages in it.
        reached: the position behind which the next batch begins.
        end: whether there is nothing more.
    """

    positions: tuple[int, ...]
    reached: int
    end: bool


@dataclass(frozen=True)
class NewestFrame:
    """Where a trajectory's newest frame is, its epoch and number, and whether its control came."""

    position: int
    epoch: str
    seq: int
    controlled: bool


@dataclass(slots=True)
class _Run:
    """Messages of one trajectory and epoch, one behind the other, whose numbers never fall."""

    epoch: str
    positions: array[int] = field(default_factory=lambda: array("q"))
    seqs: array[int] = field(default_factory=lambda: array("q"))
    sizes: array[int] = field(default_factory=lambda: array("i"))
    kinds: bytearray = field(default_factory=bytearray)

    def takes(self, epoch: str, seq: int) -> bool:
        return epoch == self.epoch and seq >= self.seqs[-1]

    def drop(self, count: int) -> int:
        """Remove that many of the oldest; their size [bytes]."""
        size = sum(self.sizes[:count])
        del self.positions[:count], self.seqs[:count], self.sizes[:count], self.kinds[:count]
        return size


class LogIndex:
    """The messages of any number of trajectories, which are numbers here, by rising position.

    Attributes:
        bytes: size of all messages.
    """

    def __init__(self) -> None:
        self.bytes = 0
        self._runs: dict[int, list[_Run]] = {}

    def add(
        self, trajectory: int, position: int, epoch: str, seq: int, kind: int, size: int
    ) -> None:
        """The newest message; its position is above all others."""
        runs = self._runs.get(trajectory)
        if runs is None:
            runs = self._runs[trajectory] = []
        if not runs or not runs[-1].takes(epoch, seq):
            runs.append(_Run(epoch))
        run = runs[-1]
        run.positions.append(position)
        run.seqs.append(seq)
        run.sizes.append(size)
        run.kinds.append(kind)
        self.bytes += size

    def first(self, trajectory: int) -> tuple[str | None, int | None]:
        """Epoch and number of the oldest message; None where there is none."""
        runs = self._runs.get(trajectory)
        return (runs[0].epoch, runs[0].seqs[0]) if runs else (None, None)

    def last(self, trajectory: int) -> tuple[str | None, int | None]:
        """Epoch and number of the newest message; None where there is none."""
        runs = self._runs.get(trajectory)
        return (runs[-1].epoch, runs[-1].seqs[-1]) if runs else (None, None)

    def newest_frame(self, trajectory: int) -> NewestFrame | None:
        """Or None where there is no frame."""
        is_last = True
        for run in reversed(self._runs.get(trajectory, ())):
            at = run.kinds.rfind(FRAME)
            is_last = is_last and at == len(run.kinds) - 1
            if at >= 0:
                return NewestFrame(run.positions[at], run.epoch, run.seqs[at], not is_last)
        return None

    def batch(self, trajectory: int, query: ReplayQuery) -> Batch:
        """What the query asks for, as far as one reply holds it."""
        start = self._start(trajectory, query) if query.after is None else query.after
        chosen: list[int] = []
        size, reached, largest = 0, start, query.max_message_bytes
        for position, length in self._behind(trajectory, start):
            if largest is None or length <= largest:
                size += length
                if len(chosen) == MAX_BATCH or (chosen and size > query.max_bytes):
                    return Batch(tuple(chosen), reached, False)
                chosen.append(position)
            reached = position
        return Batch(tuple(chosen), reached, True)

    def before(self, trajectory: int, epoch: str, seq: int) -> list[Mark]:
        """What stands before the first message of that number or a later one of its epoch.

        Nothing, where there is none such: it is of no epoch that is known here.
        """
        stays = self._find(trajectory, epoch, seq)
        marks: list[Mark] = []
        if stays is None:
            return marks
        for run in self._runs[trajectory]:
            count = bisect_left(run.positions, stays)
            for position, size in zip(run.positions[:count], run.sizes[:count], strict=True):
                marks.append((position, size, trajectory))
        return marks

    def oldest(self, size: int) -> list[Mark]:
        """The oldest messages, whosever they are, that hold so many bytes; or all."""
        marks: list[Mark] = []
        for mark in merge(*map(self._marks, self._runs)):
            if size <= 0:
                break
            marks.append(mark)
            size -= mark[1]
        return marks

    def cut(self, reached: Mapping[int, int]) -> int:
        """Remove what each trajectory has up to its position in `reached`; how many messages."""
        removed = 0
        for trajectory, position in reached.items():
            runs = self._runs.get(trajectory, [])
            while runs:
                count = bisect_right(runs[0].positions, position)
                is_whole = count == len(runs[0].positions)
                self.bytes -= runs[0].drop(count)
                removed += count
                if not is_whole:
                    break
                del runs[0]
        return removed

    def _start(self, trajectory: int, query: ReplayQuery) -> int:
        """The position behind which the wanted messages begin."""
        if query.epoch is None:
            return 0
        found = self._find(trajectory, query.epoch, query.seq)
        if found is not None:
            return found - 1
        runs = reversed(self._runs.get(trajectory, ()))
        return next((run.positions[-1] for run in runs if run.epoch == query.epoch), 0)

    def _find(self, trajectory: int, epoch: str, seq: int) -> int | None:
        """Position of the first message of the epoch with that number or a later one."""
        for run in self._runs.get(trajectory, ()):
            if run.epoch == epoch and run.seqs[-1] >= seq:
                return run.positions[bisect_left(run.seqs, seq)]
        return None

    def _behind(self, trajectory: int, start: int) -> Iterator[tuple[int, int]]:
        """Position and size of the messages behind a position."""
        for run in self._runs.get(trajectory, ()):
            for at in range(bisect_right(run.positions, start), len(run.positions)):
                yield run.positions[at], run.sizes[at]

    def _marks(self, trajectory: int) -> Iterator[Mark]:
        for position, size in self._behind(trajectory, 0):
            yield position, size, trajectory
