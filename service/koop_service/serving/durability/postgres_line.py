"""One connection to a PostgreSQL database: made when it is needed, and anew when it breaks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import psycopg

from koop_service.serving.durability.store import AwayError, StoreError

_DEFAULTS: dict[str, Any] = {
    "application_name": "koop-serve",
    "connect_timeout": 3,  # s
    "tcp_user_timeout": 5000,  # ms: else a machine that vanished is waited for for minutes
    "keepalives_idle": 5,  # s
}
_FIRST_WAIT, _LONGEST_WAIT = 0.5, 10.0
"""Seconds between two attempts to connect."""
_SCHEMA_LOCK = 0x6B6F6F70
"""Advisory lock under which the tables are made: two at once would fail."""
_TABLES = """
CREATE TABLE koop_owners_1 (
    shard text PRIMARY KEY, owner text NOT NULL, epoch bigint NOT NULL);
CREATE TABLE koop_records_1 (
    shard text, name text, record bytea NOT NULL, PRIMARY KEY (shard, name));
ALTER TABLE koop_records_1 ALTER COLUMN record SET STORAGE EXTERNAL;
"""
_SINCE = "ALTER TABLE koop_records_1 ADD COLUMN saved_at timestamptz NOT NULL DEFAULT now()"
"""A column that the first tables had not; what they held counts as saved when it was added."""


class DatabaseLine:
    """A connection by these parameters, for one thread at a time; `clock` tells seconds."""

    def __init__(self, parameters: Mapping[str, Any], clock: Callable[[], float]) -> None:
        self._parameters: dict[str, Any] = {**_DEFAULTS, **parameters}
        host = parameters.get("host", "this machine")
        self._where = f"{parameters.get('dbname', '')} on {host}"
        self._clock = clock
        self._connection: psycopg.Connection[Any] | None = None
        self._wait = 0.0
        self._not_before = float("-inf")

    @contextmanager
    def transaction(self) -> Iterator[psycopg.Cursor[Any]]:
        """Committed at the end. After an error of the connection's the next one gets a new one.

        Raises StoreError where the server refuses, AwayError where it cannot be reached.
        """
        try:
            connection = self._connected()
            with connection.transaction(), connection.cursor() as cursor:
                yield cursor
        except psycopg.Error as error:
            broken = self._connection is None or self._connection.closed
            if broken:
                self.close()
            kind = AwayError if broken else StoreError
            raise kind(f"the state in the database {self._where}: {_said(error)}") from error

    def close(self) -> None:
        """Let go of the connection."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _connected(self) -> psycopg.Connection[Any]:
        if self._connection is None:
            if self._clock() < self._not_before:
                raise AwayError(f"the database {self._where} is away; it is tried again soon")
            self._wait = min(max(2 * self._wait, _FIRST_WAIT), _LONGEST_WAIT)
            self._not_before = self._clock() + self._wait
            connection = psycopg.connect(**self._parameters, autocommit=True)
            _make_tables(connection)
            self._connection = connection
            self._wait = 0.0
        return self._connection


def _make_tables(connection: psycopg.Connection[Any]) -> None:
    with connection.transaction(), connection.cursor() as cursor:
        cursor.execute("SELECT pg_advisory_xact_lock(%s)", (_SCHEMA_LOCK,))
        cursor.execute("SELECT to_regclass('koop_records_1')")
        if cursor.fetchone() == (None,):
            cursor.execute(_TABLES)
        cursor.execute(
            "SELECT 1 FROM pg_attribute "
            "WHERE attrelid = to_regclass('koop_records_1') AND attname = 'saved_at'"
        )
        if cursor.fetchone() is None:
            cursor.execute(_SINCE)


def _said(error: psycopg.Error) -> str:
    """The server's words on one line."""
    return " ".join(str(error).split()) or type(error).__name__
