"""Which trajectories are due for a snapshot, and copying them between two batches.

A round begins every few seconds with the trajectories that have changed since the last one. They
are copied a few at a time, so that no query waits for all of them; each copy is of one moment, and
trajectories have nothing to do with each other.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from koop_protocol import Durable
from koop_service.serving.durability.archive import Archive
from koop_service.serving.durability.keeper import Keeper, Snapshot
from koop_service.serving.trajectories.records import snapshot_of
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory

_LEAST, _MOST, _PART = 0.0002, 0.002, 0.07
"""Time for copies between two batches [s]: this part of what has passed since the last ones, so
that who comes meanwhile waits for little, and a busy service is done with them in time."""
_BETWEEN = 0.001
"""Pause between two such times where nothing else is to be done [s]: without one, Zenoh's threads
would wait for the interpreter until the last copy, and a frame with them."""
_LEAVING = 1024
"""Trajectories that may have left memory without being on disk; further ones wait for the disk."""
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
        archive: Archive,
        is_logged: Callable[[str], bool],
        every: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._registry = registry
        self._keeper = keeper
        self._archive = archive
        self._is_logged = is_logged
        self._every = every
        self._clock = clock
        self._changed: dict[str, None] = {}
        self._due: list[str] = []
        self._batch: dict[str, Snapshot] = {}
        self._handed: dict[str, Snapshot] = {}
        self._next = clock() + every
        self._copied = clock()
        self._is_first = True
        self._changed_since: float | None = None
        self._round_since: float | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a round is under way."""
        return bool(self._due)

    def age(self) -> float:
        """Age of the oldest change that is not on disk yet [s]."""
        now, keeper = self._clock(), self._keeper
        is_stored = not self._due and keeper.is_idle and keeper.is_durable
        since = (None if is_stored else self._round_since, self._changed_since)
        return now - min((time for time in since if time is not None), default=now)

    def pause(self) -> float:
        """Time until `step` has something to do [s]."""
        if self._due:
            return max(0.0, self._copied + _BETWEEN - self._clock())
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
            now = self._clock()
            self._copy(now + min(_MOST, max(_LEAST, _PART * (now - self._copied))))
            self._copied = self._clock()
        elif self._every and self._clock() >= self._next and self._keeper.is_idle:
            self._begin()

    def hasten(self) -> None:
        """All have caught up: the first round begins now, so that the next kill does not find the
        state as far behind as this one did. Later rounds keep their time."""
        if self._is_first:
            self._next = self._clock()

    def finish(self) -> None:
        """Hand over all that has changed, the round under way included."""
        self._begin()
        self._copy(float("inf"))

    # Trajectories that leave memory, and come back

    def has_room(self) -> bool:
        """Whether a further trajectory may leave; waits for the disk where many have left."""
        if len(self._archive) < _LEAVING:
            return True
        if not self._keeper.is_durable:
            return False
        self.finish()
        self._keeper.wait()
        self._settle()
        return len(self._archive) < _LEAVING

    def leave(self, trajectory: Trajectory) -> None:
        """It leaves memory: keep what is not on the disk yet."""
        name = trajectory.name
        if trajectory.stream.epoch is None:
            return  # nothing was folded
        if name in self._changed or name in self._due:
            self._archive.add(name, self._snapshot(trajectory))
        elif name in self._batch:
            self._archive.add(name, self._batch[name])
        elif name in self._handed:
            self._archive.add(name, self._handed[name])

    def recall(self, name: str) -> dict[str, Any] | None:
        """The record of a trajectory that may come back; raises as `Archive.recall`."""
        return self._archive.recall(name)

    def arrived(self, name: str) -> None:
        """It came back. It is stored anew even where it is on the disk: it is in use again."""
        self._archive.remove(name)
        self._changed[name] = None

    def _settle(self) -> set[str]:
        """After the keeper is done with a batch; which trajectories are not stored after all."""
        failed = self._keeper.take_failed()
        self._archive.settle({n: s for n, s in self._handed.items() if n not in failed})
        self._handed = {}
        return failed

    def _begin(self) -> None:
        self._is_first = False
        self._copied = self._clock()
        self._next = self._copied + self._every
        self._keeper.wait()
        failed = self._settle()
        changed = dict.fromkeys([*self._due, *failed, *self._changed])
        since = (self._round_since if failed or self._due else None, self._changed_since)
        self._round_since = min((t for t in since if t is not None), default=None)
        self._changed, self._changed_since = {}, None
        self._due = list(changed)[::-1]

    def _copy(self, deadline: float) -> None:
        """Copy the next ones; hand them over after the last."""
        while self._due:
            name = self._due.pop()
            leaving, trajectory = self._archive.leaving(name), self._registry.held(name)
            if leaving is not None:
                self._batch[name] = leaving
            elif trajectory is not None and trajectory.stream.epoch is not None:
                self._batch[name] = self._snapshot(trajectory)
            if self._clock() >= deadline:
                break
        if not self._due and self._batch:
            batch, self._batch = self._batch, {}
            self._handed = batch
            self._keeper.hand_over(batch)

    def _snapshot(self, trajectory: Trajectory) -> Snapshot:
        stream, durable = trajectory.stream, None
        if self._is_logged(trajectory.name) and stream.epoch is not None:
            durable = Durable(trajectory.name, stream.epoch, stream.replay_from)
        return Snapshot(snapshot_of(trajectory), durable)
