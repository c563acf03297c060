"""`koop-serve --workers N`: several workers, by default processes of this machine, and their hub.

The supervisor learns nothing and answers nothing. It starts the workers, puts a spare in the place
of one that dies, starts a new spare, and stops them all.
"""

from __future__ import annotations

import logging
import queue
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from koop_service.encoding.catalogue import bundled_or_own
from koop_service.serving.config import NetworkSettings, ServiceConfig
from koop_service.serving.placement.hub import hub
from koop_service.serving.placement.member import FENCED
from koop_service.serving.placement.processes import Process
from koop_service.serving.placement.roster import Roster
from koop_service.serving.sharding.ownership import listed, share
from koop_service.serving.sharding.settings import TOLD_LATER, PlacementSettings
from koop_service.serving.toml import dump_config

log = logging.getLogger("koop.workers")

_STOPPING = 8.0
"""Seconds that stopping workers have before they are killed."""


def supervise(config: ServiceConfig) -> int:
    """Run until SIGINT or SIGTERM; the exit code."""
    events: queue.SimpleQueue[Event] = queue.SimpleQueue()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: events.put((None, {"event": "stop"})))
    with hub(config.network) as shared, tempfile.TemporaryDirectory(prefix="koop-") as folder:
        file = Path(folder) / "worker.toml"
        file.write_text(dump_config(member_config(config, shared.network)), encoding="utf-8")
        start = partial(Process, file, events)
        return Supervisor(config.placement, shared.endpoints, start, events).run()


class Member(Protocol):
    """Something that runs a worker, or waits to be told which one.

    It puts events of itself into the supervisor's queue: `prepared`; `ready`, with the worker, its
    metrics' port and how many trajectories it continues; and at last `exit` with a code.
    """

    @property
    def pid(self) -> int:
        """Its process."""
        ...

    def tell(self, line: str) -> None:
        """Which worker it is to be."""
        ...

    def stop(self) -> None:
        """Ask it to stop."""
        ...

    def end(self, timeout: float) -> int:
        """Its exit code; ended by force when it takes longer than `timeout` [s]."""
        ...


Event = tuple[Member | None, dict[str, Any]]
"""None is the supervisor itself, told to stop."""


def member_config(config: ServiceConfig, network: NetworkSettings) -> ServiceConfig:
    """What a worker is started with: it is told later which one it is."""
    models = tuple(
        replace(rule, path=bundled_or_own(rule.path), name=rule.name or rule.path.stem)
        for rule in config.models
    )
    return replace(
        config, models=models, network=network, placement=PlacementSettings(worker=TOLD_LATER)
    )


class Supervisor:
    """The members, by the roster's decisions; `start` begins one, `endpoints` are the hub's."""

    def __init__(
        self,
        placement: PlacementSettings,
        endpoints: list[str],
        start: Callable[[], Member],
        events: queue.SimpleQueue[Event],
    ) -> None:
        self._count = placement.workers or 1
        self._endpoints = endpoints
        self._start = start
        self._events = events
        self._roster: Roster[Member] = Roster(self._count, placement.spares)
        self._alive: set[Member] = set()
        self._idle: set[Member] = set()
        self._served: set[int] = set()

    def run(self) -> int:
        """Until somebody says stop, or a worker cannot start at all; the exit code."""
        code = None
        try:
            while code is None:
                self._start_missing()
                code = self._attend()
        finally:
            stopped = self._stop()
        return code or stopped

    def _start_missing(self) -> None:
        for _ in range(self._roster.to_start(time.monotonic())):
            member = self._start()
            self._alive.add(member)
            self._roster.started(member)

    def _attend(self) -> int | None:
        """Wait for something to happen, and deal with it; an exit code when it is over."""
        wake = self._roster.wake()
        try:
            timeout = None if wake is None else max(0.0, wake - time.monotonic())
            member, told = self._events.get(timeout=timeout)
        except queue.Empty:
            return None
        if member is None:
            return 0
        if told["event"] == "prepared":
            self._roster.prepared(member)
            self._idle.add(member)
        elif told["event"] == "ready":
            self._note_ready(member, told)
        elif told["event"] == "exit" and self._bury(member, told["code"]):
            return 1
        self._seat()
        return None

    def _seat(self) -> None:
        for member, seat in self._roster.seat():
            self._idle.discard(member)
            member.tell(f"{seat}/{self._count}")
        for member in self._idle:
            log.info("a spare is ready to take over (process %d)", member.pid)
        self._idle.clear()

    def _note_ready(self, member: Member, told: dict[str, Any]) -> None:
        seat = int(told["worker"].split("/")[0])
        if len(self._served) < self._count:
            self._served.add(seat)
            if len(self._served) == self._count:
                self._greet()
        metrics = f", metrics on port {told['metrics_port']}" if told["metrics_port"] else ""
        log.info(
            "worker %s serves the shards %s (process %d%s); trajectories continued: %d",
            told["worker"],
            listed(share(seat, self._count)),
            member.pid,
            metrics,
            told["restored"],
        )

    def _bury(self, member: Member, code: int) -> bool:
        """Account for one that is gone; whether that is the end: it could never start, or it
        is not wanted any more."""
        self._alive.discard(member)
        seat = self._roster.died(member, time.monotonic())
        who = "a spare" if seat is None else f"worker {seat}/{self._count}"
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        if code > 0 and not self._served:
            log.error("%s could not start (%s); stopping", who, how)
            return True
        if code == FENCED:
            log.error("%s lost its shards to another service on this state; stopping", who)
            return True
        log.warning("%s (process %d) ended with %s; another takes over", who, member.pid, how)
        return False

    def _greet(self) -> None:
        where = ", ".join(self._endpoints) or "the routers they are connected to"
        print(f"koop-serve is ready on {where}", flush=True)
        print(f"  workers: {self._count}", flush=True)
        print("  try: koop-sim-client --system cartpole    (Ctrl-C stops)", flush=True)

    def _stop(self) -> int:
        """Stop all of them; 1 if one failed or had to be killed. A spare may not listen yet."""
        for member in self._alive:
            member.stop()
        deadline = time.monotonic() + _STOPPING
        codes = [member.end(max(0.0, deadline - time.monotonic())) for member in self._alive]
        return int(any(code not in (0, -signal.SIGTERM) for code in codes))
