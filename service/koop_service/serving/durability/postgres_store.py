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
from koop_service.serving.durability.postgres_line import DatabaseLine
from koop_service.serving.durability.store import Claim, FencedError


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
        # Two connections: a record is found while another thread saves.
        self._changes, self._look_ups = (DatabaseLine(given, clock) for _ in range(2))

    def claim(self, owner: str, shards: Collection[str]) -> Claim:
        """See SnapshotStore."""
        wanted = sorted(shards)
        with self._changes.transaction() as cursor:
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

    def load(self, shards: Collection[str], most: int | None = None) -> dict[str, bytes]:
        """See SnapshotStore."""
        with self._changes.transaction() as cursor:
            cursor.execute(
                "SELECT name, record FROM koop_records_1 WHERE shard = ANY(%s) LIMIT %s",
                (sorted(shards), most),
                binary=True,
            )
            return {name: bytes(record) for name, record in cursor}

    def find(self, name: str) -> bytes | None:
        """See SnapshotStore."""
        with self._look_ups.transaction() as cursor:
            cursor.execute(
                "SELECT record FROM koop_records_1 WHERE shard = %s AND name = %s",
                (shard_of(name), name),
                binary=True,
            )
            found = cursor.fetchone()
            return None if found is None else bytes(found[0])

    def save(self, claim: Claim, records: Mapping[str, bytes]) -> None:
        """See SnapshotStore."""
        rows = [(shard_of(name), name, record) for name, record in sorted(records.items())]
        with self._changing(claim, records) as cursor:
            cursor.executemany(
                "INSERT INTO koop_records_1 VALUES (%s, %s, %b) "
                "ON CONFLICT (shard, name) "
                "DO UPDATE SET record = excluded.record, saved_at = excluded.saved_at",
                rows,
            )

    def delete(self, claim: Claim, names: Collection[str]) -> None:
        """See SnapshotStore."""
        with self._changing(claim, names) as cursor:
            cursor.execute(
                "DELETE FROM koop_records_1 WHERE shard = ANY(%s) AND name = ANY(%s)",
                (sorted(set(map(shard_of, names))), list(names)),
            )

    def silent(self, shards: Collection[str], seconds: float) -> list[str]:
        """See SnapshotStore; by the server's clock."""
        with self._changes.transaction() as cursor:
            cursor.execute(
                "SELECT name FROM koop_records_1 "
                "WHERE shard = ANY(%s) AND saved_at <= now() - make_interval(secs => %s)",
                (sorted(shards), seconds),
            )
            return [name for (name,) in cursor]

    def close(self) -> None:
        """See SnapshotStore."""
        self._changes.close()
        self._look_ups.close()

    @contextmanager
    def _changing(self, claim: Claim, names: Iterable[str]) -> Iterator[psycopg.Cursor[Any]]:
        """A transaction that no claim of these shards can overtake."""
        shards = sorted(claim.check(names))
        with self._changes.transaction() as cursor:
            newer = [c for c in _owners(cursor, shards, "SHARE") if c.epoch != claim.epoch]
            if newer:
                raise FencedError(claim, frozenset().union(*(c.shards for c in newer)), newer[0])
            yield cursor


def _owners(cursor: psycopg.Cursor[Any], shards: list[str], strength: LiteralString) -> list[Claim]:
    """Who has each of these shards; the rows are held, always in one order, until the end."""
    query = "SELECT shard, owner, epoch FROM koop_owners_1 WHERE shard = ANY(%s) ORDER BY shard"
    cursor.execute(query + " FOR " + strength, (shards,))
    found = {shard: (owner, epoch) for shard, owner, epoch in cursor}
    return [Claim(*found.get(shard, ("nobody", 0)), frozenset({shard})) for shard in shards]
