"""The store that workers on several machines share: a PostgreSQL database, one transaction a batch.

Two tables, made on first use in the connection's own schema. A batch holds the rows of its shards'
owners until it is committed, and a claim changes them: so a batch is either over before the claim,
or it is refused.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, LiteralString

import psycopg
from psycopg.conninfo import conninfo_to_dict

from koop_protocol import shard_of
from koop_service.serving.durability.store import AwayError, Claim, FencedError, StoreError

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


class PostgresStore:
    """Records in the database that `url` names. It connects when it is first used.

    Raises ValueError for something that is no PostgreSQL URL, StoreError where the server refuses,
    and AwayError where it cannot be reached: then it is tried again, at most every ten seconds.
    """

    def __init__(self, url: str, clock: Callable[[], float] = time.monotonic) -> None:
        try:
            given = conninfo_to_dict(url)
        except psycopg.Error as error:
            raise ValueError(f"the state store is no PostgreSQL URL: {error}") from None
        self._parameters: dict[str, Any] = {**_DEFAULTS, **given}
        self._where = f"{given.get('dbname', '')} on {given.get('host', 'this machine')}"
        self._clock = clock
        self._connection: psycopg.Connection[Any] | None = None
        self._wait = 0.0
        self._not_before = float("-inf")

    def claim(self, owner: str, shards: Collection[str]) -> Claim:
        """See SnapshotStore."""
        wanted = sorted(shards)
        with self._transaction() as cursor:
            cursor.execute(
                "INSERT INTO koop_owners_1 SELECT shard, 'nobody', 0 "
                "FROM unnest(%s::text[]) AS shard ON CONFLICT DO NOTHING",
                (wanted,),
            )
            former = _owners(cursor, wanted, "UPDATE")
            claim = Claim(owner, 1 + max((c.epoch for c in former), default=0), frozenset(wanted))
            cursor.execute(
                "UPDATE koop_owners_1 SET owner = %s, epoch = %s WHERE shard = ANY(%s)",
                (claim.owner, claim.epoch, wanted),
            )
        return claim

    def load(self, shards: Collection[str]) -> dict[str, bytes]:
        """See SnapshotStore."""
        with self._transaction() as cursor:
            cursor.execute(
                "SELECT name, record FROM koop_records_1 WHERE shard = ANY(%s)",
                (sorted(shards),),
                binary=True,
            )
            return {name: bytes(record) for name, record in cursor}

    def save(self, claim: Claim, records: Mapping[str, bytes]) -> None:
        """See SnapshotStore."""
        rows = [(shard_of(name), name, record) for name, record in sorted(records.items())]
        with self._changing(claim, records) as cursor:
            cursor.executemany(
                "INSERT INTO koop_records_1 VALUES (%s, %s, %b) "
                "ON CONFLICT (shard, name) DO UPDATE SET record = excluded.record",
                rows,
            )

    def delete(self, claim: Claim, names: Collection[str]) -> None:
        """See SnapshotStore."""
        with self._changing(claim, names) as cursor:
            cursor.execute(
                "DELETE FROM koop_records_1 WHERE shard = ANY(%s) AND name = ANY(%s)",
                (sorted(set(map(shard_of, names))), list(names)),
            )

    def close(self) -> None:
        """See SnapshotStore."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    @contextmanager
    def _changing(self, claim: Claim, names: Iterable[str]) -> Iterator[psycopg.Cursor[Any]]:
        """A transaction that no claim of these shards can overtake."""
        shards = sorted(claim.check(names))
        with self._transaction() as cursor:
            newer = [c for c in _owners(cursor, shards, "SHARE") if c.epoch != claim.epoch]
            if newer:
                raise FencedError(claim, frozenset().union(*(c.shards for c in newer)), newer[0])
            yield cursor

    @contextmanager
    def _transaction(self) -> Iterator[psycopg.Cursor[Any]]:
        """Committed at the end. After an error of the connection's the next one gets a new one."""
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


def _owners(cursor: psycopg.Cursor[Any], shards: list[str], strength: LiteralString) -> list[Claim]:
    """Who has each of these shards; the rows are held, always in one order, until the end."""
    query = "SELECT shard, owner, epoch FROM koop_owners_1 WHERE shard = ANY(%s) ORDER BY shard"
    cursor.execute(query + " FOR " + strength, (shards,))
    found = {shard: (owner, epoch) for shard, owner, epoch in cursor}
    return [Claim(*found.get(shard, ("nobody", 0)), frozenset({shard})) for shard in shards]


def _said(error: psycopg.Error) -> str:
    """The server's words on one line."""
    return " ".join(str(error).split()) or type(error).__name__
