"""The messages of a source on disk: one SQLite file, written before each put.

SQLite keeps a write-ahead log beside the file and writes a message with one small append, without
waiting for the disk. What was appended outlives a kill of this process at any moment. A loss of
power may cost what the disk had not got yet (see docs/reliability.md), never the file.
"""

from __future__ import annotations

import fcntl
import logging
import os
import sqlite3
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from koop_protocol import MAX_BATCH, Durable, ReplayQuery, ReplayReply, check_trajectory

log = logging.getLogger("koop.log")

FRAME, CONTROL = 0, 1

_VERSION = 1
_SCHEMA = """
CREATE TABLE trajectories (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, dropped INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE messages (
    position INTEGER PRIMARY KEY, trajectory INTEGER NOT NULL,
    epoch TEXT NOT NULL, seq INTEGER NOT NULL, kind INTEGER NOT NULL, data BLOB NOT NULL
);
CREATE INDEX by_trajectory ON messages (trajectory, position);
"""
_ROOM = 16
"""What is dropped at once to make room: this part of the whole."""
_FORGET = """
DELETE FROM messages WHERE position IN (
    SELECT position FROM messages WHERE trajectory = ? AND position < (
        SELECT position FROM messages WHERE trajectory = ? AND epoch = ? AND seq >= ?
        ORDER BY position LIMIT 1
    ) ORDER BY position LIMIT ?
) RETURNING length(data)
"""
_CHUNK, _AT_ONCE = 64, 16
"""Messages of a trajectory, and trajectories, in one transaction that forgets; so that nobody waits
long for the next append."""
_LONG = 32 << 20
"""Size of the write-ahead log from which on it is emptied, with appends waiting meanwhile."""


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
    it cannot be made. A file that is no SQLite file any more is renamed, with a warning, and a new
    one takes its place. All methods may be called from any thread.

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
        self._held = _lock(path)
        try:
            self._writer = _sound(path)
            self._reader = _connect(path)
        except BaseException:
            os.close(self._held)
            raise
        self._writing, self._reading = threading.Lock(), threading.Lock()
        self._ids: dict[str, int] = dict(self._writer.execute("SELECT name, id FROM trajectories"))
        self._bytes: int = self._one("SELECT total(length(data)) FROM messages") or 0
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
        return int(self._bytes)

    def append(self, trajectory: str, epoch: str, seq: int, kind: int, data: bytes) -> None:
        """Keep a message; it must follow on the trajectory's former ones.

        Raises sqlite3.Error where the disk does not take it.
        """
        with self._writing:
            if self._bytes + len(data) > self.max_bytes:
                self._make_room(len(data))
            row = (self._position + 1, self._id(trajectory), epoch, seq, kind, data)
            self._writer.execute("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?)", row)
            self._position += 1
            self._bytes += len(data)

    def read(self, trajectory: str, query: ReplayQuery) -> ReplayReply:
        """What the query asks for, as far as one reply holds it."""
        with self._reading, _transaction(self._reader, "BEGIN"):
            number = self._ids.get(trajectory, 0)
            start = self._start(number, query) if query.after is None else query.after
            messages, position, end = self._batch(number, start, query)
            return ReplayReply(
                trajectory,
                tuple(messages),
                position,
                end,
                *self._edge(number, "ASC"),
                *self._edge(number, "DESC"),
                dropped=self._one("SELECT dropped FROM trajectories WHERE id = ?", number) or 0,
            )

    def forget(self, durable: Iterable[Durable]) -> int:
        """Delete what is of no use any more; how many messages. Another epoch's is left alone."""
        waiting, count = deque(durable), 0
        while waiting:
            group = [waiting.popleft() for _ in range(min(len(waiting), _AT_ONCE))]
            # One transaction for many trajectories: it is what costs most.
            with self._writing, _transaction(self._writer, "BEGIN IMMEDIATE"):
                for entry in group:
                    deleted = self._forget_some(entry)
                    count += deleted
                    if deleted == _CHUNK:
                        waiting.append(entry)
        return count

    def tail(self, trajectory: str) -> Tail | None:
        """The newest frame, or None where there is none."""
        number = self._ids.get(trajectory, 0)
        with self._reading:
            row = self._reader.execute(
                "SELECT epoch, seq, data, position FROM messages WHERE trajectory = ? AND kind = ?"
                " ORDER BY position DESC LIMIT 1",
                (number, FRAME),
            ).fetchone()
            if row is None:
                return None
            later = "SELECT 1 FROM messages WHERE trajectory = ? AND position > ?"
            return Tail(row[0], row[1], row[2], bool(self._one(later, number, row[3])))

    def tidy(self) -> None:
        """Move the write-ahead log into the file: in the background, as often as once a second."""
        is_long = _size(Path(f"{self.path}-wal")) > _LONG
        with self._reading:
            # Where it is long once more, so that little is left for when appends have to wait.
            for _ in range(1 + is_long):
                self._reader.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        if is_long:
            with self._writing:
                self._writer.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()

    def close(self) -> None:
        """Let go of the file."""
        with self._writing, self._reading:
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
        wanted = self._bytes + size - self.max_bytes + self.max_bytes // _ROOM
        dropped: Counter[int] = Counter()
        freed, last = 0, 0
        rows = self._writer.execute(
            "SELECT position, trajectory, length(data) FROM messages ORDER BY position"
        )
        for position, trajectory, length in rows:
            if freed >= wanted:
                break
            freed, last = freed + length, position
            dropped[trajectory] += 1
        rows.close()
        with _transaction(self._writer, "BEGIN IMMEDIATE"):
            self._writer.execute("DELETE FROM messages WHERE position <= ?", (last,))
            self._writer.executemany(
                "UPDATE trajectories SET dropped = dropped + ? WHERE id = ?",
                [(count, trajectory) for trajectory, count in dropped.items()],
            )
        self._bytes -= freed
        log.warning(
            "the log %s is full: %d messages that the service has not on disk yet are dropped; "
            "give it more than %d bytes, or see why the service does not take them",
            self.path,
            dropped.total(),
            self.max_bytes,
        )

    def _start(self, number: int, query: ReplayQuery) -> int:
        """The position behind which the wanted messages begin."""
        if query.epoch is None:
            return 0
        of_epoch = "FROM messages WHERE trajectory = ? AND epoch = ?"
        first = f"SELECT position {of_epoch} AND seq >= ? ORDER BY position LIMIT 1"
        found = self._one(first, number, query.epoch, query.seq)
        if found is not None:
            return found - 1
        return self._one(f"SELECT max(position) {of_epoch}", number, query.epoch) or 0

    def _batch(self, number: int, start: int, query: ReplayQuery) -> tuple[list[bytes], int, bool]:
        """Messages behind `start`, the position reached, and whether that is the end."""
        messages: list[bytes] = []
        size, position, largest = 0, start, query.max_message_bytes
        rows = self._reader.execute(
            "SELECT position, data FROM messages WHERE trajectory = ? AND position > ?"
            " ORDER BY position",
            (number, start),
        )
        for at, data in rows:
            if largest is None or len(data) <= largest:
                size += len(data)
                if len(messages) == MAX_BATCH or (messages and size > query.max_bytes):
                    rows.close()
                    return messages, position, False
                messages.append(data)
            position = at
        return messages, position, True

    def _edge(self, number: int, order: str) -> tuple[str | None, int | None]:
        """Epoch and number of the trajectory's oldest (ASC) or newest (DESC) message."""
        row = self._reader.execute(
            f"SELECT epoch, seq FROM messages WHERE trajectory = ? ORDER BY position {order}"
            " LIMIT 1",
            (number,),
        ).fetchone()
        return (None, None) if row is None else row

    def _forget_some(self, durable: Durable) -> int:
        """Delete a chunk of what stands before the first message that must stay."""
        number = self._ids.get(durable.trajectory, 0)
        rows = self._writer.execute(_FORGET, (number, number, durable.epoch, durable.seq, _CHUNK))
        sizes = [size for (size,) in rows.fetchall()]
        self._bytes -= sum(sizes)
        return len(sizes)

    def _one(self, statement: str, *values: object) -> Any:
        """The first value that the statement finds, or None."""
        row = self._reader.execute(statement, values).fetchone()
        return None if row is None else row[0]


def _lock(path: Path) -> int:
    """A file's descriptor; the lock is gone with the process, however that ends."""
    held = os.open(f"{path}.lock", os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(held)
        raise ValueError(
            f"another process is using the log {path}; give each its own, or stop that one"
        ) from error
    return held


def _sound(path: Path) -> sqlite3.Connection:
    """A connection to the file, with its tables; what is no database any more is set aside."""
    try:
        return _prepared(_connect(path), path)
    except sqlite3.DatabaseError as error:
        if isinstance(error, sqlite3.OperationalError):  # not damaged: no room, or no permission
            raise OSError(f"the log {path} cannot be used: {error}") from error
        aside = path.with_name(f"{path.name}.{time.time_ns()}.unfit")
        for part in ("", "-wal", "-shm"):
            if Path(f"{path}{part}").exists():
                os.replace(f"{path}{part}", f"{aside}{part}")
        log.warning("the log %s is damaged (%s); it is kept as %s", path, error, aside.name)
        return _prepared(_connect(path), path)


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        # SQLite would move the write-ahead log in the middle of an append, and wait for the disk.
        connection.execute("PRAGMA wal_autocheckpoint = 0")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


def _prepared(connection: sqlite3.Connection, path: Path) -> sqlite3.Connection:
    found = connection.execute("PRAGMA user_version").fetchone()[0]
    if found not in (0, _VERSION):
        connection.close()
        raise ValueError(
            f"the log {path} is of version {found}; this koop knows version {_VERSION}: give "
            "another file"
        )
    if found == 0:
        with _transaction(connection, "BEGIN IMMEDIATE"):
            for statement in _SCHEMA.split(";"):
                connection.execute(statement)
            connection.execute(f"PRAGMA user_version = {_VERSION}")
    return connection


@contextmanager
def _transaction(connection: sqlite3.Connection, begin: str) -> Iterator[None]:
    connection.execute(begin)
    try:
        yield
    except BaseException:
        if connection.in_transaction:  # a full disk ends it by itself
            connection.execute("ROLLBACK")
        raise
    connection.execute("COMMIT")


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
