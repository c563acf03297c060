"""Trajectories that are not in use leave memory for the disk, and come back when they are.

The registry says who leaves and who comes back; here it is tied to snapshots, tasks and memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from koop_service.serving.durability.snapshotter import Snapshotter
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory


class Eviction:
    """The registry's archive. Owned by the pipeline's thread.

    after: time without a message or a query after which a trajectory leaves [s]; 0: none does, but
    to make room. spares: a trajectory that somebody controls; is_pressed: memory is short.
    """

    def __init__(
        self,
        registry: Registry,
        snapshotter: Snapshotter,
        metrics: Metrics,
        after: float,
        spares: Callable[[str], bool],
        is_pressed: Callable[[], bool],
    ) -> None:
        self._registry = registry
        self._snapshotter = snapshotter
        self._metrics = metrics
        self._after = after
        self._spares = spares
        self._is_pressed = is_pressed
        registry.archive = self

    def step(self) -> None:
        """Between two batches: whoever is idle leaves."""
        if self._after:
            self._registry.evict_idle(self._after)

    def has_room(self) -> bool:
        """Whether a further one can be kept; waits for the disk where many have just left."""
        return self._snapshotter.has_room()

    def leave(self, trajectory: Trajectory) -> None:
        """Keep it."""
        self._snapshotter.leave(trajectory)
        self._metrics.evicted.inc()

    def recall(self, name: str) -> dict[str, Any] | None:
        """The record of one that may come back; raises as `Archive.recall`."""
        return self._snapshotter.recall(name)

    def arrived(self, name: str) -> None:
        """It came back."""
        self._snapshotter.arrived(name)
        self._metrics.revived.inc()

    def spares(self, name: str) -> bool:
        """Whether it must not leave to make room for another."""
        return self._spares(name)

    def is_pressed(self) -> bool:
        """Whether memory is short."""
        return self._is_pressed()
