"""The snapshot store that the settings name, and a claim of it, however long that takes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Collection

from koop_service.serving.config import ServiceConfig
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.durability.store import AwayError, Claim, SnapshotStore, StoreError

log = logging.getLogger("koop.snapshots")

_RETRY = 0.5
"""Seconds between two attempts."""


def open_store(config: ServiceConfig) -> SnapshotStore:
    """PostgreSQL where a database is named, else LMDB in the state folder. Raises StoreError."""
    if config.state_store is None:
        return LmdbStore(config.state_folder)
    try:
        from koop_service.serving.durability.postgres_store import PostgresStore
    except ImportError as error:
        raise StoreError(
            f"--state-store needs psycopg ({error}); pip install 'koop[cluster]'"
        ) from error
    return PostgresStore(config.state_store)


def claim_and_load(
    store: SnapshotStore,
    owner: str,
    shards: Collection[str],
    most: int,
    stop: threading.Event,
) -> tuple[Claim, dict[str, bytes]] | None:
    """The claim and `most` records; None if `stop` was set before the store's server was there.

    It waits for the server: to begin with nothing would put an empty state in the place of the
    stored one. Raises StoreError for whatever waiting does not help with.
    """
    told = False
    while not stop.is_set():
        try:
            claim = store.claim(owner, shards)
            return claim, store.load(shards, most)
        except AwayError as error:
            if not told:
                log.warning("%s; waiting for it", error)
            told = True
            stop.wait(_RETRY)
    return None
