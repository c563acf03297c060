"""The SQLite file beneath a log: it belongs to one process, and is sound and of this version."""

from __future__ import annotations

import fcntl
import logging
import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from koop_clients.replay.index import LogIndex

log = logging.getLogger("koop.log")

_VERSION = 2
_SCHEMA = """
CREATE TABLE trajectories (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, dropped INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE messages (
    position INTEGER PRIMARY KEY, trajectory INTEGER NOT NULL,
    epoch TEXT NOT NULL, seq INTEGER NOT NULL, kind INTEGER NOT NULL, data BLOB NOT NULL
);
"""
_LARGEST_JOURNAL = 64 << 20
"""Size [bytes] to which a write-ahead log is cut back that grew larger, when it begins anew."""
_STEPS = {0: _SCHEMA, 1: "DROP INDEX by_trajectory"}
"""What makes a file of that version, or an empty one, one of this version."""
_ALL = "SELECT trajectory, position, epoch, seq, kind, length(data) FROM messages ORDER BY position"


def lock(path: Path) -> int:
    """A descriptor that holds the file for this process; the lock is gone however that ends.

    Raises ValueError where another process has it.
    """
    held = os.open(f"{path}.lock", os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(held)
        raise ValueError(
            f"another process is using the log {path}; give each its own, or stop that one"
        ) from error
    return held


def open_sound(path: Path) -> tuple[sqlite3.Connection, LogIndex]:
    """A connection to the file, and what it holds; what is damaged is renamed, and a new one made.

    Raises ValueError where the file is of another version, OSError where it cannot be used.
    """
    try:
        return _open(path)
    except sqlite3.DatabaseError as error:
        if isinstance(error, sqlite3.OperationalError):  # not damaged: no room, or no permission
            raise OSError(f"the log {path} cannot be used: {error}") from error
        aside = path.with_name(f"{path.name}.{time.time_ns()}.unfit")
        for part in ("", "-wal", "-shm"):
            if Path(f"{path}{part}").exists():
                os.replace(f"{path}{part}", f"{aside}{part}")
        log.warning("the log %s is damaged (%s); it is kept as %s", path, error, aside.name)
        return _open(path)


def connect(path: Path) -> sqlite3.Connection:
    """Any thread may use it, one at a time."""
    connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        # SQLite would move the write-ahead log in the middle of an append, and wait for the disk.
        connection.execute("PRAGMA wal_autocheckpoint = 0")
        connection.execute(f"PRAGMA journal_size_limit = {_LARGEST_JOURNAL}")
        # Some distributions' SQLite writes zeros over all that is deleted: most of its cost.
        connection.execute("PRAGMA secure_delete = OFF")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


@contextmanager
def transaction(connection: sqlite3.Connection, begin: str) -> Iterator[None]:
    """All or nothing: where it raises, nothing was changed."""
    connection.execute(begin)
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:  # a full disk ends it by itself
            connection.execute("ROLLBACK")
        raise


def _open(path: Path) -> tuple[sqlite3.Connection, LogIndex]:
    connection = connect(path)
    try:
        _bring_up_to_date(connection, path)
        return connection, _index_of(connection)
    except BaseException:
        connection.close()
        raise


def _bring_up_to_date(connection: sqlite3.Connection, path: Path) -> None:
    found = connection.execute("PRAGMA user_version").fetchone()[0]
    if found == _VERSION:
        return
    if found not in _STEPS:
        raise ValueError(
            f"the log {path} is of version {found}; this koop knows version {_VERSION} and those "
            "before: give another file"
        )
    with transaction(connection, "BEGIN IMMEDIATE"):
        for statement in _STEPS[found].split(";"):
            connection.execute(statement)
        connection.execute(f"PRAGMA user_version = {_VERSION}")


def _index_of(connection: sqlite3.Connection) -> LogIndex:
    """One walk over the file, which leaves out the pages that hold nothing but a message's data."""
    index = LogIndex()
    try:
        for row in connection.execute(_ALL):
            index.add(*row)
    except (TypeError, ValueError, OverflowError) as error:
        raise sqlite3.DatabaseError(f"a row is no message: {error}") from error
    return index
