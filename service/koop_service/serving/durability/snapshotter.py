"""Which trajectories are due for a snapshot, and copying them between two batches.

A round begins every few seconds with the trajectories that have changed since the last one. They
are copied a few at a time, so that no query waits for all of them; each copy is of one moment, and
trajectories have nothing to do with each other.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from koop_protocol import Durable
from koop_service.serving.durability.keeper import Keeper, Snapshot
from koop_service.serving.records import snapshot_of
from koop_service.serving.registry import Registry
from koop_service.serving.trajectories import Trajectory

_BUDGET = 0.002
"""Time for copies between two batches [s]."""
_LONG, _STORING = 3600.0, 0.02
"""Pauses where there is nothing to do, and while the former round is being stored [s]."""


class Snapshotter:
    """Owned by the pipeline's thread.

    every: time from one round to the next [s]; 0: there are none before the end.
    is_logged: whether the trajectory's source waits to hear what is durable.
    """

    def __init__(
        self,
        registry: Registry,
        keeper: Keeper,
        is_logged: Callable[[str], bool],
        every: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._registry = registry
        self._keeper = keeper
        self._is_logged = is_logged
        self._every = every
        self._clock = clock
        self._changed: dict[str, None] = {}
        self._due: list[str] = []
        self._batch: dict[str, Snapshot] = {}
        self._next = clock() + every
        self._changed_since: float | None = None
        self._round_since: float | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a round is under way."""
        return bool(self._due)

    def age(self) -> float:
        """Age of the oldest change that is not on disk yet [s]."""
        known = (self._round_since, self._changed_since)
        return self._clock() - min((t for t in known if t is not None), default=self._clock())

    def pause(self) -> float:
        """Time until `step` has something to do [s]."""
        if self._due:
            return 0.0
        if not self._every:
            return _LONG
        return max(0.0 if self._keeper.is_idle else _STORING, self._next - self._clock())

    def note(self, trajectories: Iterable[Trajectory]) -> None:
        """These have changed."""
        for trajectory in trajectories:
            self._changed[trajectory.name] = None
        if self._changed and self._changed_since is None:
            self._changed_since = self._clock()

    def step(self) -> None:
        """Begin a round where one is due, or go on with it."""
        if self._due:
            self._copy(self._clock() + _BUDGET)
        elif self._every and self._clock() >= self._next and self._keeper.is_idle:
            self._begin()

    def finish(self) -> None:
        """Hand over all that has changed, the round under way included."""
        self._begin()
        self._copy(float("inf"))

    def _begin(self) -> None:
        self._next = self._clock() + self._every
        failed = self._keeper.take_failed()
        changed = dict.fromkeys([*self._due, *failed, *self._changed])
        since = (self._round_since if failed or self._due else None, self._changed_since)
        self._round_since = min((t for t in since if t is not None), default=None)
        self._changed, self._changed_since = {}, None
        self._due = list(changed)[::-1]

    def _copy(self, deadline: float) -> None:
        """Copy the next ones; hand them over after the last."""
        while self._due:
            name = self._due.pop()
            trajectory = self._registry.find(name)
            if trajectory is not None and trajectory.stream.epoch is not None:
                self._batch[name] = self._snapshot(trajectory)
            if self._clock() >= deadline:
                break
        if not self._due and self._batch:
            batch, self._batch = self._batch, {}
            self._keeper.hand_over(batch)

    def _snapshot(self, trajectory: Trajectory) -> Snapshot:
        stream, durable = trajectory.stream, None
        if self._is_logged(trajectory.name) and stream.epoch is not None:
            durable = Durable(trajectory.name, stream.epoch, stream.replay_from)
        return Snapshot(snapshot_of(trajectory), durable)
