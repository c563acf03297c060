"""The messages of a source on disk: one SQLite file, written before each put.

SQLite keeps a write-ahead log beside the file and writes a message with one small append, without
waiting for the disk. What was appended outlives a kill of this process at any moment. A loss of
power may cost what the disk had not got yet (see docs/reliability.md), never the file.

The file alone is the truth. The index in memory follows it, once a transaction is through.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from koop_clients.replay.database import connect, lock, open_sound, transaction
from koop_clients.replay.index import CONTROL, FRAME, Mark
from koop_protocol import Durable, ReplayQuery, ReplayReply, check_trajectory

__all__ = ["CONTROL", "FRAME", "LogFile", "Tail"]

log = logging.getLogger("koop.log")

_ROOM = 16
"""What is dropped at once to make room: this part of the whole."""
_CHUNK, _CHUNK_BYTES = 1024, 4 << 20
"""Most messages in one transaction that forgets, and about their bytes; so that nobody waits long
for the next append."""
_LONG = 8192
"""Pages in the write-ahead log (32 MiB) from which on it begins anew, with appends waiting."""


@dataclass(frozen=True)
class Tail:
    """The newest frame of a trajectory: its epoch, number, bytes, and whether its control came."""

    epoch: str
    seq: int
    data: bytes
    controlled: bool


class LogFile:
    """Frames and controls of any number of trajectories, in the order in which they were put.

    Raises ValueError where another process has the file, or it is of another version; OSError where
    it cannot be made. A file that is no sound SQLite file any more is renamed, with a warning, and
    a new one takes its place. All methods may be called from any thread.

    Attributes:
        path: where it is.
        max_bytes: of all messages; beyond it the oldest are dropped.
    """

    def __init__(self, path: Path, max_bytes: int) -> None:
        if max_bytes < 1:
            raise ValueError(f"max_bytes is {max_bytes}; expected a number of bytes above 0")
        self.path = path
        self.max_bytes = max_bytes
        path.parent.mkdir(parents=True, exist_ok=True)
        self._held = lock(path)
        try:
            self._writer, self._index = open_sound(path)
            self._reader = connect(path)
        except BaseException:
            os.close(self._held)
            raise
        # Whoever takes both takes `reading` first. The index belongs to `writing`.
        self._writing, self._reading = threading.Lock(), threading.Lock()
        self._ids: dict[str, int] = dict(self._writer.execute("SELECT name, id FROM trajectories"))
        # Never a number twice, even where all messages were forgotten before this run.
        last = self._one("SELECT max(position) FROM messages") or 0
        self._position: int = max(last, time.time_ns() // 1000)

    @property
    def trajectories(self) -> list[str]:
        """All names that ever put anything."""
        return list(self._ids)

    @property
    def bytes(self) -> int:
        """Size of all messages held."""
        return self._index.bytes

    def append(self, trajectory: str, epoch: str, seq: int, kind: int, data: bytes) -> None:
        """Keep a message; it must follow on the trajectory's former ones.

        Raises sqlite3.Error where the disk does not take it.
        """
        with self._writing:
            if self._index.bytes + len(data) > self.max_bytes:
                self._make_room(len(data))
            number = self._id(trajectory)
            self._position += 1
            row = (self._position, number, epoch, seq, kind, data)
            self._writer.execute("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?)", row)
            self._index.add(number, self._position, epoch, seq, kind, len(data))

    def read(self, trajectory: str, query: ReplayQuery) -> ReplayReply:
        """What the query asks for, as far as one reply holds it."""
        number = self._ids.get(trajectory, 0)
        with self._reading, transaction(self._reader, "BEGIN"):
            with self._writing:
                # The first statement decides what the transaction sees: just what the index says.
                dropped = self._one("SELECT dropped FROM trajectories WHERE id = ?", number) or 0
                batch = self._index.batch(number, query)
                first, last = self._index.first(number), self._index.last(number)
            messages = tuple(map(self._data, batch.positions))
        return ReplayReply(
            trajectory, messages, batch.reached, batch.end, *first, *last, dropped=dropped
        )

    def forget(self, durable: Iterable[Durable], between: Callable[[], None] | None = None) -> int:
        """Delete what is of no use any more; how many messages. Another epoch's is left alone.

        Where there is much, `between` is called now and then; it may do with the log what it likes.
        """
        marks: list[Mark] = []
        for entry in durable:
            number = self._ids.get(entry.trajectory, 0)
            with self._writing:
                marks += self._index.before(number, entry.epoch, entry.seq)
        # As they lie in the file, whosever they are: so each page is written once.
        marks.sort()
        count = 0
        for chunk in _chunks(marks):
            with self._writing:
                count += self._delete(chunk)
            if between is not None:
                between()
        return count

    def tail(self, trajectory: str) -> Tail | None:
        """The newest frame, or None where there is none."""
        with self._reading, self._writing:
            frame = self._index.newest_frame(self._ids.get(trajectory, 0))
            if frame is None:
                return None
            return Tail(frame.epoch, frame.seq, self._data(frame.position), frame.controlled)

    def tidy(self) -> None:
        """Move the write-ahead log into the file: in the background, as often as once a second."""
        with self._reading:
            is_long = self._checkpoint() > _LONG
            if is_long:  # once more, so that little is left for when appends have to wait
                self._checkpoint()
        if is_long:
            with self._writing:
                # Not truncated: to write over it costs the kernel less than to let it grow anew.
                self._writer.execute("PRAGMA wal_checkpoint(RESTART)").fetchone()

    def close(self) -> None:
        """Let go of the file."""
        with self._reading, self._writing:
            self._reader.close()
            self._writer.close()
            os.close(self._held)

    def _id(self, trajectory: str) -> int:
        number = self._ids.get(trajectory)
        if number is None:
            name = check_trajectory(trajectory)
            cursor = self._writer.execute("INSERT INTO trajectories (name) VALUES (?)", (name,))
            number = self._ids[name] = int(cursor.lastrowid or 0)
        return number

    def _make_room(self, size: int) -> None:
        """Drop the oldest messages, whosever they are, and keep count."""
        wanted = self._index.bytes + size - self.max_bytes + self.max_bytes // _ROOM
        marks = self._index.oldest(wanted)
        if not marks:  # a message larger than all of it
            return
        self._delete(marks, Counter(trajectory for _, _, trajectory in marks))
        log.warning(
            "the log %s is full: %d messages that the service has not on disk yet are dropped; "
            "give it more than %d bytes, or see why the service does not take them",
            self.path,
            len(marks),
            self.max_bytes,
        )

    def _delete(self, marks: list[Mark], dropped: Mapping[int, int] | None = None) -> int:
        """Of each trajectory its oldest messages, by rising position; how many were there still.

        `dropped`: how many of each trajectory's are to be counted as lost.
        """
        counts = [(count, trajectory) for trajectory, count in (dropped or {}).items()]
        with transaction(self._writer, "BEGIN IMMEDIATE"):
            self._writer.executemany(
                "DELETE FROM messages WHERE position BETWEEN ? AND ?", _stretches(marks)
            )
            self._writer.executemany(
                "UPDATE trajectories SET dropped = dropped + ? WHERE id = ?", counts
            )
        return self._index.cut({trajectory: position for position, _, trajectory in marks})

    def _checkpoint(self) -> int:
        """Beside appends; pages in the write-ahead log."""
        return self._reader.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()[1]

    def _data(self, position: int) -> bytes:
        data = self._one("SELECT data FROM messages WHERE position = ?", position)
        if data is None:
            raise sqlite3.DatabaseError(f"message {position} of {self.path} is not there any more")
        return data

    def _one(self, statement: str, *values: object) -> Any:
        """The first value that the statement finds, or None."""
        row = self._reader.execute(statement, values).fetchone()
        return None if row is None else row[0]


def _chunks(marks: list[Mark]) -> Iterator[list[Mark]]:
    """What one transaction deletes, and the next."""
    chunk: list[Mark] = []
    size = 0
    for mark in marks:
        chunk.append(mark)
        size += mark[1]
        if len(chunk) == _CHUNK or size >= _CHUNK_BYTES:
            yield chunk
            chunk, size = [], 0
    if chunk:
        yield chunk


def _stretches(marks: list[Mark]) -> Iterator[tuple[int, int]]:
    """First and last of the positions that follow on each other."""
    first = last = marks[0][0]
    for position, _, _ in marks:
        if position > last + 1:
            yield first, last
            first = position
        last = position
    yield first, last
