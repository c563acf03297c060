"""What a worker can be told about its share of the trajectories, and `koop-serve` about workers."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from koop_service.serving.sharding.ownership import (
    Ownership,
    check_count,
    named_shards,
    worker_shards,
)

TOLD_LATER = "-"
"""As `worker`: it is told on standard input."""


@dataclass(frozen=True)
class PlacementSettings:
    """Several workers, each with a share of the trajectories; see docs/scaling.md."""

    workers: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: no others)")] = (
        None
    )
    """Run so many workers as processes of their own, restart those that die, and be their hub."""
    spares: int = 1
    """Processes that have loaded everything and wait to take a dead worker's place; with
    --workers or --ray."""
    ray: bool = False
    """Run the --workers as actors of a Ray cluster; needs koop[cluster]."""
    worker: Annotated[
        str | None, arg(metavar="K/N", help_behavior_hint="(default: the only one)")
    ] = None
    """Be worker K, from 0, of N, which others run: own its share of the trajectories and be silent
    about the rest. ordinal/N takes K from the end of the host's name (koop-1), '-' from a line on
    standard input, and stops when that is closed."""
    shards: Annotated[
        tuple[str, ...] | None, arg(metavar="SHARD ...", help_behavior_hint="(default: all)")
    ] = None
    """Own these shards, as in keys, such as 00-0f 20; in place of --worker."""

    def __post_init__(self) -> None:
        if self.workers is not None:
            check_count(self.workers)
        if self.spares < 0:
            raise ValueError(f"spares is {self.spares}; expected 0 or more")
        chosen = [n for n in ("workers", "worker", "shards") if getattr(self, n) is not None]
        if len(chosen) > 1:
            raise ValueError(f"{' and '.join(chosen)} are given; expected at most one of them")
        if self.ray and self.workers is None:
            raise ValueError("ray is given without workers; expected --ray --workers N")
        if not self.told_later:
            self.ownership()

    @property
    def told_later(self) -> bool:
        """Whether standard input will say which worker this is."""
        return self.worker == TOLD_LATER

    def ownership(self) -> Ownership:
        """The shards of this process."""
        if self.shards is not None:
            return Ownership(named_shards(self.shards))
        if self.worker is not None:
            return Ownership(worker_shards(self.worker, socket.gethostname()))
        return Ownership()
