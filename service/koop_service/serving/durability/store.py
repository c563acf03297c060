"""Where snapshots of trajectories are kept: what every store does, whatever it is built on.

A store holds one sealed record (see `sealing.py`) for each trajectory, by its name. Whoever wants
to write claims shards first. A claim has an *epoch*, higher than that of every former claim of
these shards, and each write is refused once somebody else has claimed one of its shards: a service
that was taken for dead, and is not, cannot overwrite what its successor has stored.

    OSError
    └── StoreError        it cannot be done now; what was stored before is still there
        ├── AwayError     the store's server cannot be reached; it may be there later
        └── FencedError   it can never be done: the shards belong to somebody else by now
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from koop_protocol import shard_of
from koop_service.serving.sharding.ownership import listed


@dataclass(frozen=True)
class Claim:
    """The right to write records of these shards, until somebody claims one of them anew.

    owner: who it is, for people. epoch: higher than those of all former claims of these shards.
    """

    owner: str
    epoch: int
    shards: frozenset[str]

    def check(self, names: Iterable[str]) -> frozenset[str]:
        """The shards of these trajectories. Raises ValueError where one is not claimed."""
        found = frozenset(map(shard_of, names))
        if found - self.shards:
            raise ValueError(
                f"{self.owner} writes to the shards {listed(found - self.shards)}; expected only "
                f"those that it has claimed, {listed(self.shards)}"
            )
        return found


class StoreError(OSError):
    """The store cannot be read or written at present; str() says why."""


class AwayError(StoreError):
    """The store's server cannot be reached at present."""


class FencedError(StoreError):
    """A newer owner has claimed these shards; nothing of this batch was written."""

    def __init__(self, claim: Claim, shards: Collection[str], newer: Claim) -> None:
        super().__init__(claim, shards, newer)
        self.claim = claim
        self.shards = frozenset(shards)
        self.newer = newer

    def __str__(self) -> str:
        return (
            f"{self.newer.owner} has claimed the shards {listed(self.shards)} from "
            f"{self.claim.owner} (claim {self.newer.epoch} after {self.claim.epoch}), which must "
            "not write them any more; stop one of the two"
        )


class SnapshotStore(Protocol):
    """Sealed records by trajectory. Not for several threads at once.

    Every method raises StoreError where the store is out of order. After that it may be called
    again: it works once the cause (a full disk, a lost connection) is gone.
    """

    def claim(self, owner: str, shards: Collection[str]) -> Claim:
        """Take these shards over, at once and as one, from whoever has them."""
        ...

    def load(self, shards: Collection[str], most: int | None = None) -> dict[str, bytes]:
        """The records of the trajectories of these shards, `most` of them. Claim the shards first:
        else the former owner may still change them."""
        ...

    def find(self, name: str) -> bytes | None:
        """The record of one trajectory, where there is one.

        Alone of all methods it may be called while another thread is in `save` or `delete`; the
        caller waits for it, so it has to be fast.
        """
        ...

    def save(self, claim: Claim, records: Mapping[str, bytes]) -> None:
        """Put these records in the place of the former ones: all or none, and durable on return.

        Raises FencedError, or ValueError for a trajectory of a shard that is not claimed.
        """
        ...

    def delete(self, claim: Claim, names: Collection[str]) -> None:
        """Remove the records of these trajectories, where there are any; raises as `save`."""
        ...

    def silent(self, shards: Collection[str], seconds: float) -> list[str]:
        """Trajectories of these shards whose records were last saved so long ago, or longer."""
        ...

    def close(self) -> None:
        """Let go of files and connections."""
        ...
