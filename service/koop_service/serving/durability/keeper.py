"""Writes snapshots out of a thread of its own, and tells sources what they need not keep.

A slow disk holds nobody up: while one batch is written, no further one is asked for. Where the
store is out of order the service goes on, and says that nothing is durable.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from koop_protocol import Durable, durable_key, encode
from koop_service.serving.durability.retention import Retention
from koop_service.serving.durability.store import Claim, FencedError, SnapshotStore, StoreError
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.trajectories.sealing import seal

log = logging.getLogger("koop.snapshots")

_AT_A_STRETCH, _REST = 0.0002, 4.0
"""Time for which snapshots are packed [s] before the pipeline's thread has so many times as long:
they share one interpreter, and it would wait for this thread at each of an encoder's layers."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A trajectory's record, and what its source may forget once that is stored (None: nobody)."""

    record: Mapping[str, Any]
    durable: Durable | None


class Keeper:
    """Stores batches of snapshots by trajectory, one at a time.

    `put` sends a payload on a key; `fenced` is called once somebody else has claimed the shards.
    All public methods but `start` may be called from any thread.
    """

    def __init__(
        self,
        store: SnapshotStore,
        claim: Claim,
        put: Callable[[str, bytes], None],
        metrics: Metrics,
        fenced: Callable[[], None] = lambda: None,
        retention: Retention | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._claim = claim
        self._put = put
        self._metrics = metrics
        self._fenced = fenced
        self._retention = retention
        self._clock = clock
        self._brake = Brake()
        self._batch: dict[str, Snapshot] | None = None
        self._failed: set[str] = set()
        self._is_durable, self._is_fenced = True, False
        self._work = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="koop-keeper", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Store what was handed over, and end."""
        with self._work:
            self._stopping = True
            self._work.notify_all()
        self._thread.join()

    @property
    def is_durable(self) -> bool:
        """Whether the last batch could be stored."""
        return self._is_durable

    @property
    def is_fenced(self) -> bool:
        """Whether somebody else has claimed the shards."""
        return self._is_fenced

    @property
    def is_idle(self) -> bool:
        """Whether a batch would be taken at once."""
        return self._batch is None

    def hand_over(self, batch: dict[str, Snapshot]) -> None:
        """Store a batch, after the one before it; nobody may change it any more."""
        with self._work:
            self._work.wait_for(lambda: self._batch is None)
            self._batch = batch
            self._work.notify_all()

    def wait(self) -> None:
        """Until what was handed over is stored, or has failed."""
        with self._work:
            self._work.wait_for(lambda: self._batch is None)

    def take_failed(self) -> set[str]:
        """Trajectories whose snapshots could not be stored since the last call."""
        with self._work:
            failed, self._failed = self._failed, set()
            return failed

    def _run(self) -> None:
        while True:
            with self._work:
                self._work.wait_for(
                    lambda: self._batch is not None or self._stopping, self._patience()
                )
                batch, stopping = self._batch, self._stopping
            if batch is None:
                if stopping:
                    return
                self._retain()
                continue
            started = self._clock()
            stored = self._store_all(batch)
            with self._work:
                self._batch = None
                if not stored:
                    self._failed |= batch.keys()
                self._work.notify_all()
            if stored:
                self._metrics.storing.observe(self._clock() - started)
                self._acknowledge(batch)

    def _patience(self) -> float | None:
        """How long to wait for a batch [s]."""
        return None if self._retention is None or self._is_fenced else self._retention.pause()

    def _retain(self) -> None:
        if self._retention is not None:
            try:
                self._retention.step()
            except FencedError as error:
                self._complain(error)
            except Exception:
                log.exception("old states could not be deleted; they are looked at again later")

    def _store_all(self, batch: Mapping[str, Snapshot]) -> bool:
        """Whether it is on the disk."""
        if self._is_fenced:
            return False
        try:
            self._store.save(self._claim, self._sealed(batch))
        except Exception as error:
            self._complain(error)
            return False
        if not self._is_durable:
            log.warning("states are stored again")
        self._is_durable = True
        self._metrics.snapshots.inc(len(batch))
        return True

    def _sealed(self, batch: Mapping[str, Snapshot]) -> dict[str, bytes]:
        """All of them as bytes; taking it easy, but at the end."""
        sealed: dict[str, bytes] = {}
        started = self._clock()
        for name, snapshot in batch.items():
            sealed[name] = seal(dict(snapshot.record))
            worked = self._clock() - started
            if worked >= _AT_A_STRETCH and not self._stopping:
                time.sleep(_REST * worked)
                started = self._clock()
        return sealed

    def _complain(self, error: Exception) -> None:
        self._is_durable, self._is_fenced = False, isinstance(error, FencedError)
        self._metrics.unstored.inc()
        if self._is_fenced:
            log.error("nothing is durable any more: %s", error)
            self._fenced()
        elif self._brake.admit(type(error).__name__) is None:
            return
        elif isinstance(error, StoreError):
            log.error("nothing is durable at present: %s; the service goes on", error)
        else:
            log.exception("nothing is durable at present; the service goes on")

    def _acknowledge(self, batch: Mapping[str, Snapshot]) -> None:
        for name, snapshot in batch.items():
            if snapshot.durable is None:
                continue
            try:
                self._put(durable_key(name), encode(snapshot.durable))
            except Exception:
                if self._brake.admit("put") is not None:
                    log.exception("a source could not be told what is durable")
