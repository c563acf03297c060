"""Where tasks meet the network: owners come and go, frames are folded, commands go out."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping

from koop_protocol import Command, LqrCancel, LqrEnd, LqrReply, LqrTask, command_key, encode
from koop_service.serving.admission.news import Presence
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.steering.tasks import Tasks
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory

log = logging.getLogger("koop.tasks")


class Commander:
    """Runs the tasks in the pipeline's thread; `send` puts a payload on a key and never waits."""

    def __init__(
        self,
        tasks: Tasks,
        registry: Registry,
        send: Callable[[str, bytes], None],
        metrics: Metrics,
    ) -> None:
        self._tasks = tasks
        self._registry = registry
        self._send = send
        self._metrics = metrics
        self._brake = Brake()

    def attend(self, presences: Iterable[Presence]) -> None:
        """Notice who came and went, in that order, and whose time is over."""
        for presence in presences:
            if presence.here:
                self._tasks.welcome(presence.owner)
            else:
                self._announce(self._tasks.bid_farewell(presence.owner))
        if len(self._tasks):
            self._announce(self._tasks.expire())
            self._announce(self._tasks.evict(self._registry))

    def command(self, folded: Mapping[Trajectory, float]) -> None:
        """At the newest frame of each trajectory, given the time at which it came [s]."""
        if not len(self._tasks):
            return
        for trajectory, arrived in folded.items():
            try:
                self._command(trajectory, arrived)
            except Exception:
                self._metrics.commands.labels("lost").inc()
                if self._brake.admit("command") is not None:
                    log.exception("a command of %r failed; the service goes on", trajectory.name)

    def begin(self, trajectory: Trajectory, order: LqrTask) -> LqrReply:
        """Begin a task; ProtocolError where it cannot be."""
        former = self._tasks.find(trajectory.name)
        reply = self._tasks.begin(trajectory, order)
        if former is None and self._tasks.find(trajectory.name) is not None:
            log.info("%r controls %s", order.owner, trajectory.name)
        return reply

    def cancel(self, trajectory: Trajectory, order: LqrCancel) -> LqrEnd:
        """End a task; ProtocolError where there is none of this owner's."""
        end = self._tasks.cancel(trajectory.name, order.owner)
        self._announce([end])
        return end

    def stop(self) -> None:
        """End all tasks."""
        self._announce(self._tasks.shut_down())

    def _command(self, trajectory: Trajectory, arrived: float) -> None:
        found = self._tasks.command(trajectory)
        if isinstance(found, LqrEnd):
            self._announce([found])
        elif found is not None:
            self._send(command_key(found.trajectory), encode(found))
            self._count(found, arrived)

    def _count(self, command: Command, arrived: float) -> None:
        self._metrics.commands.labels(command.status).inc()
        self._metrics.commanding.observe(time.monotonic() - arrived)

    def _announce(self, ends: Iterable[LqrEnd]) -> None:
        for end in ends:
            log.info("%r controls %s no more: %s", end.owner, end.trajectory, end.message)
            self._send(command_key(end.trajectory), encode(end))
