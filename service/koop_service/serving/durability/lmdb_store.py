"""The store on this machine: one LMDB file, kept open, one transaction a batch.

A transaction is on the disk when it returns, and a kill at any moment leaves the one before or the
one after. Several services may share the file: claims keep them apart. Whoever opens it while
nobody else has it open inspects it first; whoever joins them trusts what they do.
"""

from __future__ import annotations

import fcntl
import logging
import os
import struct
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import IO, Any, cast

import lmdb
import msgpack

from koop_protocol import shard_of
from koop_service.serving.durability.inspection import (
    FORMAT_KEY,
    OWNERS,
    RECORDS,
    TIMES,
    why_unfit,
)
from koop_service.serving.durability.store import Claim, FencedError, StoreError

log = logging.getLogger("koop.snapshots")

_FILE = "estimators.lmdb"
_USERS = "estimators.lmdb-users"
"""Locked by whoever has the file open, together, or alone to set it aside."""
_FORMAT = b"koop-state-1"
_TIME = struct.Struct("<d")
"""When a record was saved, in seconds since 1970."""
_CLOCK_SET = 1.7e9
"""No clock that is set shows an earlier time [s]."""
_FIRST_SIZE = 64 << 20
"""Size of the map to begin with [bytes]; it doubles when it is full. The file is not larger than
what is in it."""


class LmdbStore:
    """Records in `folder`, which is made where it is missing.

    Raises StoreError where the folder or the file cannot be used. A file that is damaged, or of
    another version, is renamed, with a line in the log, and a new one takes its place. `clock`, of
    seconds since 1970, dates the records.
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = time.time) -> None:
        self._path = folder / _FILE
        self._clock = clock
        self._environment: lmdb.Environment | None = None
        self._records: Any = None
        # Held where nobody may be reading: while the map grows, and while the file is opened anew.
        self._reading = threading.RLock()
        _prepare(folder)
        self._users = (folder / _USERS).open("a")
        if _is_first(self._users):
            self._set_aside_if_unfit()
        with self._opened():
            fcntl.flock(self._users, fcntl.LOCK_SH)

    def claim(self, owner: str, shards: Collection[str]) -> Claim:
        """See SnapshotStore."""

        def write(environment: lmdb.Environment) -> Claim:
            owners = environment.open_db(OWNERS)
            with environment.begin(write=True, db=owners) as transaction:
                former = [_claim_in(transaction, shard).epoch for shard in shards]
                claim = Claim(owner, 1 + max(former, default=0), frozenset(shards))
                entry = cast(bytes, msgpack.packb([claim.owner, claim.epoch]))
                for shard in claim.shards:
                    transaction.put(shard.encode(), entry)
            return claim

        return self._write(write)

    def load(self, shards: Collection[str], most: int | None = None) -> dict[str, bytes]:
        """See SnapshotStore."""
        with self._opened() as environment:
            records = environment.open_db(RECORDS)
            with environment.begin(db=records) as transaction:
                return dict(islice(_entries(transaction, records, shards), most))

    def find(self, name: str) -> bytes | None:
        """See SnapshotStore."""
        with self._reading:  # and nothing is closed here: another thread may be writing
            try:
                environment = self._present()
                with environment.begin(db=self._records) as transaction:
                    found = transaction.get(_key(name))
            except lmdb.Error as error:
                raise StoreError(f"the state in {self._path} cannot be read: {error}") from error
        return None if found is None else bytes(found)

    def save(self, claim: Claim, records: Mapping[str, bytes]) -> None:
        """See SnapshotStore."""

        now = _TIME.pack(self._clock())

        def put(transaction: lmdb.Transaction, times: Any) -> None:
            for name, record in records.items():
                transaction.put(_key(name), record)
                transaction.put(_key(name), now, db=times)

        self._change(claim, records, put)

    def delete(self, claim: Claim, names: Collection[str]) -> None:
        """See SnapshotStore."""

        def delete(transaction: lmdb.Transaction, times: Any) -> None:
            for name in names:
                transaction.delete(_key(name))
                transaction.delete(_key(name), db=times)

        self._change(claim, names, delete)

    def silent(self, shards: Collection[str], seconds: float) -> list[str]:
        """See SnapshotStore. A record without a date, of an earlier koop's, gets today's; so does
        one of a machine whose clock was not set yet.
        """
        now = self._clock()

        def look(environment: lmdb.Environment) -> list[str]:
            times, records = environment.open_db(TIMES), environment.open_db(RECORDS)
            with environment.begin(write=True, db=times) as transaction:
                for key in _keys(transaction.cursor(records), shards):
                    dated = transaction.get(key)
                    if dated is None or _TIME.unpack(dated)[0] < _CLOCK_SET:
                        transaction.put(key, _TIME.pack(now))
                saved = _entries(transaction, times, shards)
                return [name for name, time in saved if _TIME.unpack(time)[0] <= now - seconds]

        return self._write(look)

    def close(self) -> None:
        """See SnapshotStore."""
        self._let_go()
        self._users.close()

    def _let_go(self) -> None:
        with self._reading:
            environment, self._environment = self._environment, None
            if environment is not None:
                environment.close()

    def _change(
        self, claim: Claim, names: Iterable[str], change: Callable[[lmdb.Transaction, Any], None]
    ) -> None:
        shards = claim.check(names)

        def write(environment: lmdb.Environment) -> None:
            owners, records = environment.open_db(OWNERS), environment.open_db(RECORDS)
            times = environment.open_db(TIMES)
            with environment.begin(write=True, db=records) as transaction:
                _check_claim(transaction, owners, claim, shards)
                change(transaction, times)

        self._write(write)

    def _write(self, write: Callable[[lmdb.Environment], Any]) -> Any:
        """What `write` returns; again with a larger map as long as that is full."""
        with self._opened() as environment:
            while True:
                try:
                    return write(environment)
                except lmdb.MapFullError:
                    with self._reading:
                        environment.set_mapsize(2 * environment.info()["map_size"])
                except lmdb.MapResizedError:  # by another process
                    with self._reading:
                        environment.set_mapsize(0)

    @contextmanager
    def _opened(self) -> Iterator[lmdb.Environment]:
        """The environment. After an error of LMDB's it is opened anew: some leave it unusable."""
        try:
            yield self._present()
        except lmdb.Error as error:
            self._let_go()
            raise StoreError(f"the state in {self._path} cannot be used: {error}") from error

    def _present(self) -> lmdb.Environment:
        with self._reading:
            if self._environment is None:
                self._environment = _open(self._path)
                # Kept, since to ask for it again is a write, and waits for other writers.
                self._records = self._environment.open_db(RECORDS)
            return self._environment

    def _set_aside_if_unfit(self) -> None:
        if not self._path.exists():
            return
        reason = why_unfit(self._path, _FORMAT)
        if reason:
            aside = self._path.with_name(f"{_FILE}.{time.time_ns()}.unfit")
            os.replace(self._path, aside)
            log.warning(
                "the state in %s is left out: %s; it is kept as %s", self._path, reason, aside.name
            )


def _is_first(users: IO[str]) -> bool:
    """Lock the file's users: alone, or, once nobody is alone any more, together with the others."""
    try:
        fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fcntl.flock(users, fcntl.LOCK_SH)
        return False
    return True


def _prepare(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError("it cannot be written")
    except OSError as error:
        raise StoreError(
            f"the state folder {folder} cannot be used ({error}); choose another --state-folder"
        ) from error


def _open(path: Path) -> lmdb.Environment:
    environment = lmdb.open(str(path), subdir=False, map_size=_FIRST_SIZE, max_dbs=3)
    environment.reader_check()  # readers that were killed would keep old pages from being used
    for name in (RECORDS, OWNERS, TIMES):
        environment.open_db(name)
    with environment.begin(write=True) as transaction:
        transaction.put(FORMAT_KEY, _FORMAT)
    return environment


def _key(name: str) -> bytes:
    """Records of one shard stand together."""
    return f"{shard_of(name)}/{name}".encode()


def _entries(
    transaction: lmdb.Transaction, database: Any, shards: Collection[str]
) -> Iterator[tuple[str, bytes]]:
    """By trajectory, what the database holds of these shards' ones."""
    cursor = transaction.cursor(database)
    for key in _keys(cursor, shards):
        yield key.decode().split("/", 1)[1], bytes(cursor.value())


def _keys(cursor: lmdb.Cursor, shards: Collection[str]) -> Iterator[bytes]:
    """The keys of these shards, in order; the cursor stands at each."""
    for shard in sorted(shards):
        prefix = f"{shard}/".encode()
        found = cursor.set_range(prefix)
        while found and (key := bytes(cursor.key())).startswith(prefix):
            yield key
            found = cursor.next()


def _claim_in(transaction: lmdb.Transaction, shard: str, database: Any = None) -> Claim:
    """Who has the shard."""
    entry = transaction.get(shard.encode(), db=database)
    owner, epoch = ("nobody", 0) if entry is None else msgpack.unpackb(entry)
    return Claim(owner, epoch, frozenset({shard}))


def _check_claim(
    transaction: lmdb.Transaction, owners: Any, claim: Claim, shards: Iterable[str]
) -> None:
    present = [_claim_in(transaction, shard, owners) for shard in shards]
    newer = [other for other in present if other.epoch != claim.epoch]
    if newer:
        lost = frozenset().union(*(other.shards for other in newer))
        raise FencedError(claim, lost, newer[0])
