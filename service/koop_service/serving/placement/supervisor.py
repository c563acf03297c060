"""`koop-serve --workers N`: workers as processes of this machine, and the hub that they share.

The supervisor learns nothing and answers nothing. It starts the workers, puts a spare in the place
of one that dies, starts a new spare, and stops them all.
"""

from __future__ import annotations

import logging
import queue
import signal
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from koop_service.encoding.catalogue import bundled_or_own
from koop_service.serving.config import ServiceConfig
from koop_service.serving.placement.hub import Hub, hub
from koop_service.serving.placement.member import FENCED
from koop_service.serving.placement.ownership import listed, share
from koop_service.serving.placement.processes import Event, Process
from koop_service.serving.placement.roster import Roster
from koop_service.serving.placement.settings import TOLD_LATER, PlacementSettings
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
        return Supervisor(config.placement, shared, file, events).run()


def member_config(config: ServiceConfig, network: Any) -> ServiceConfig:
    """What a worker is started with: it is told later which one it is."""
    models = tuple(
        replace(rule, path=bundled_or_own(rule.path), name=rule.name or rule.path.stem)
        for rule in config.models
    )
    return replace(
        config, models=models, network=network, placement=PlacementSettings(worker=TOLD_LATER)
    )


class Supervisor:
    """The processes, by the roster's decisions."""

    def __init__(
        self,
        placement: PlacementSettings,
        shared: Hub,
        file: Path,
        events: queue.SimpleQueue[Event],
    ) -> None:
        self._count = placement.workers or 1
        self._hub = shared
        self._file = file
        self._events = events
        self._roster: Roster[Process] = Roster(self._count, placement.spares)
        self._alive: set[Process] = set()
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
            process = Process(self._file, self._events)
            self._alive.add(process)
            self._roster.started(process)

    def _attend(self) -> int | None:
        """Wait for something to happen, and deal with it; an exit code when it is over."""
        wake = self._roster.wake()
        try:
            timeout = None if wake is None else max(0.0, wake - time.monotonic())
            process, told = self._events.get(timeout=timeout)
        except queue.Empty:
            return None
        if process is None:
            return 0
        if told["event"] == "prepared":
            self._roster.prepared(process)
        elif told["event"] == "ready":
            self._note_ready(process, told)
        elif told["event"] == "exit" and self._bury(process, told["code"]):
            return 1
        for member, seat in self._roster.seat():
            member.tell(f"{seat}/{self._count}")
        return None

    def _note_ready(self, process: Process, told: dict[str, Any]) -> None:
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
            process.pid,
            metrics,
            told["restored"],
        )

    def _bury(self, process: Process, code: int) -> bool:
        """Account for one that is gone; whether that is the end: it could never start, or it
        is not wanted any more."""
        self._alive.discard(process)
        seat = self._roster.died(process, time.monotonic())
        who = "a spare" if seat is None else f"worker {seat}/{self._count}"
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        if code > 0 and not self._served:
            log.error("%s could not start (%s); stopping", who, how)
            return True
        if code == FENCED:
            log.error("%s lost its shards to another service on this state; stopping", who)
            return True
        log.warning("%s (process %d) ended with %s; another takes over", who, process.pid, how)
        return False

    def _greet(self) -> None:
        where = ", ".join(self._hub.endpoints) or "the routers they are connected to"
        print(f"koop-serve is ready on {where}", flush=True)
        print(f"  workers: {self._count}", flush=True)
        print("  try: koop-sim-client --system cartpole    (Ctrl-C stops)", flush=True)

    def _stop(self) -> int:
        """Stop all of them; 1 if one failed or had to be killed. A spare may not listen yet."""
        for process in self._alive:
            process.stop()
        deadline = time.monotonic() + _STOPPING
        codes = [process.end(max(0.0, deadline - time.monotonic())) for process in self._alive]
        return int(any(code not in (0, -signal.SIGTERM) for code in codes))
