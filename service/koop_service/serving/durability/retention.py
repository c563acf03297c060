"""Records of trajectories that nothing was heard of for a long time are deleted.

By the keeper's thread, between two batches: so what is deleted is not being saved. A trajectory in
memory stays, however old its record is; one that comes back from the disk is stored anew, which
makes it young. Only the shards of the claim are looked at, and nothing is deleted under a claim
that is lost. It takes two looks in a row: a calendar that is wrong for a while, such as that of a
machine that has just started, deletes nothing.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from koop_service.serving.durability.store import Claim, SnapshotStore
from koop_service.serving.instruments.metrics import Metrics

log = logging.getLogger("koop.snapshots")

_EVERY = 3600.0
"""Longest time between two looks [s]."""
_AT_ONCE = 256
"""Records deleted in one transaction, so that no batch of states waits long."""


class Retention:
    """For the keeper's thread alone.

    after: time since a record was saved after which it is deleted [s]; 0: none is.
    is_here: whether the trajectory is in memory, which may be asked from any thread.
    """

    def __init__(
        self,
        store: SnapshotStore,
        claim: Claim,
        after: float,
        is_here: Callable[[str], bool],
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._claim = claim
        self._after = after
        self._is_here = is_here
        self._metrics = metrics
        self._clock = clock
        self._every = min(_EVERY, after)
        self._next = clock()
        self._old: set[str] = set()  # at the last look

    def pause(self) -> float | None:
        """Time until `step` has something to do [s]; None: it never has."""
        return max(0.0, self._next - self._clock()) if self._after else None

    def step(self) -> None:
        """Delete what is due, where it is time to look. Raises StoreError as the store does."""
        if self.pause() != 0.0:
            return
        self._next = self._clock() + self._every
        silent = self._store.silent(self._claim.shards, self._after)
        gone = [name for name in silent if name in self._old and not self._is_here(name)]
        self._old = set(silent)
        for start in range(0, len(gone), _AT_ONCE):
            names = gone[start : start + _AT_ONCE]
            self._store.delete(self._claim, names)
            self._metrics.forgotten.inc(len(names))
        if gone:
            log.info(
                "the states of %d trajectories, such as %s, are deleted: nothing was heard of them "
                "for %g days",
                len(gone),
                gone[0],
                self._after / 86400.0,
            )
