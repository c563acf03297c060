"""Trajectories that have left memory: those on their way to the disk, and those on it.

Owned by the pipeline's thread.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from koop_service.serving.durability.keeper import Snapshot
from koop_service.serving.trajectories.sealing import seal, unseal


class Archive:
    """`find` reads a sealed record from the disk, None where there is none."""

    def __init__(self, find: Callable[[str], bytes | None]) -> None:
        self._find = find
        self._leaving: dict[str, Snapshot] = {}

    def __len__(self) -> int:
        """Trajectories that have left memory and are not on the disk yet."""
        return len(self._leaving)

    def add(self, name: str, snapshot: Snapshot) -> None:
        """Keep it until it is on the disk."""
        self._leaving[name] = snapshot

    def leaving(self, name: str) -> Snapshot | None:
        """What is to be stored of a trajectory that has left."""
        return self._leaving.get(name)

    def settle(self, stored: Mapping[str, Snapshot]) -> None:
        """These are on the disk now."""
        for name, snapshot in stored.items():
            if self._leaving.get(name) is snapshot:
                del self._leaving[name]

    def recall(self, name: str) -> dict[str, Any] | None:
        """The record of a trajectory that may come back, None where there is none.

        Raises StoreError, or ValueError where the record is damaged.
        """
        snapshot = self._leaving.get(name)
        if snapshot is not None:
            # By way of bytes: the keeper may be reading this very record.
            return unseal(seal(dict(snapshot.record)))
        sealed = self._find(name)
        return None if sealed is None else unseal(sealed)

    def remove(self, name: str) -> None:
        """It came back."""
        self._leaving.pop(name, None)
