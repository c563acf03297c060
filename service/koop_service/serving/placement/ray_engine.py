"""`koop-serve --ray --workers N`: the workers are actors, which Ray places on its machines.

The same supervisor as for processes: it puts a spare in the place of a worker that dies, since an
actor that Ray restarts would first have to load everything. Ray decides where each new one runs, so
that workers move off a machine that is gone.

Without RAY_ADDRESS a Ray instance begins on this machine, on loopback, and ends with the service.
"""

from __future__ import annotations

import importlib
import itertools
import logging
import os
import queue
import signal
import threading
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from koop_service.serving.config import NetworkSettings, ServiceConfig
from koop_service.serving.instruments import logs
from koop_service.serving.instruments.process import limit_arenas
from koop_service.serving.placement.hub import hub
from koop_service.serving.placement.member import FENCED
from koop_service.serving.placement.supervisor import Event, Supervisor, member_config
from koop_service.serving.sharding.settings import PlacementSettings
from koop_service.serving.toml import dump_config, parse_config

log = logging.getLogger("koop.workers")

_COMPOSITION = "koop_service.cli"
"""What an actor runs, by name: Ray would send a function of the main module as code."""
_OBJECTS = 80 << 20
"""Ray's object store, which is not used, at its smallest [bytes]."""


def supervise_on_ray(config: ServiceConfig) -> int:
    """Run until SIGINT or SIGTERM; the exit code. Raises OSError where Ray is not installed."""
    ray = _ray(config)
    events: queue.SimpleQueue[Event] = queue.SimpleQueue()
    for number in (signal.SIGINT, signal.SIGTERM):  # after Ray's own
        signal.signal(number, lambda *_: events.put((None, {"event": "stop"})))
    try:
        with hub(config.network) as shared:
            network = config.network
            if shared.endpoints:
                network = NetworkSettings(connect=tuple(shared.endpoints))
            settings = dump_config(member_config(config, network))
            numbers = itertools.count()
            return Supervisor(
                config.placement,
                shared.endpoints,
                lambda: RayMember(ray, settings, next(numbers), events),
                events,
            ).run()
    finally:
        ray.shutdown()


class RayMember:
    """One actor; what it does goes into `events`, out of a thread that waits for it."""

    def __init__(
        self, ray: Any, settings: str, number: int, events: queue.SimpleQueue[Event]
    ) -> None:
        self._ray = ray
        self._events = events
        self._orders: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._ended = threading.Event()
        self._code = self._killed = -signal.SIGKILL
        self.pid = 0
        self._actor = (
            ray.remote(Host)
            .options(
                name=f"koop-member-{number}",
                num_cpus=1,
                max_concurrency=3,
                scheduling_strategy="SPREAD",
            )
            .remote(settings)
        )
        threading.Thread(target=self._follow, name="koop-actor", daemon=True).start()

    def tell(self, line: str) -> None:
        """See Member."""
        self._orders.put(line)

    def stop(self) -> None:
        """See Member. One that still loads has nothing to end."""
        self._orders.put(None)
        if self.pid:
            self._actor.stop.remote()
        else:
            self._killed = -signal.SIGTERM
            self._ray.kill(self._actor)

    def end(self, timeout: float) -> int:
        """See Member."""
        if not self._ended.wait(timeout):
            self._ray.kill(self._actor)
        return self._code

    def _follow(self) -> None:
        try:
            self._code = self._live()
        except self._ray.exceptions.RayActorError:
            self._code = self._killed
        except Exception as error:
            log.error("an actor failed: %s", getattr(error, "cause", None) or error)
            self._code = 1
        self._ended.set()
        self._events.put((self, {"event": "exit", "code": self._code}))

    def _live(self) -> int:
        get = self._ray.get
        self.pid = get(self._actor.prepare.remote())
        self._events.put((self, {"event": "prepared"}))
        # An actor that dies while it waits is noticed by this call alone.
        over = self._actor.over.remote()
        while True:
            try:
                worker = self._orders.get(timeout=0.1)
                break
            except queue.Empty:
                if self._ray.wait([over], timeout=0)[0]:
                    return get(over)
        if worker is not None:
            ready = get(self._actor.serve.remote(worker))
            self._events.put((self, {"event": "ready", **ready}))
        return get(over)


class Host:
    """The actor: loads everything, then serves as the worker that it is told to be."""

    def __init__(self, settings: str) -> None:
        self._settings = settings
        self._stop = threading.Event()
        self._over = threading.Event()
        self._stack = ExitStack()
        self._keeper: Any = None

    def prepare(self) -> int:
        """Load; the process's number. Raises ValueError or OSError as a service alone does."""
        limit_arenas()
        self._config = parse_config(self._settings)
        self._composition = importlib.import_module(_COMPOSITION)
        self._equipment = self._composition.equip(self._config)
        return os.getpid()

    def serve(self, worker: str) -> dict[str, Any]:
        """Begin; what the supervisor wants to know."""
        monitoring = self._config.monitoring
        logs.configure(monitoring.log_format, monitoring.log_level, worker)
        config = replace(self._config, placement=PlacementSettings(worker=worker))
        session = self._composition.reach(config, self._stop)
        assert session is not None, "it was stopped before it had begun"
        self._stack.enter_context(session)
        running = self._composition.running(config, session, self._equipment, self._stop)
        service = self._stack.enter_context(running)
        self._keeper = service.keeper
        port, restored = service.metrics_port, service.restored
        return {"worker": worker, "metrics_port": port, "restored": restored}

    def over(self) -> int:
        """Wait until it is stopped; the exit code."""
        self._stop.wait()
        self._stack.close()
        return FENCED if self._keeper is not None and self._keeper.is_fenced else 0

    def stop(self) -> None:
        """End what `over` waits for."""
        self._stop.set()


def _ray(config: ServiceConfig) -> Any:
    """Ray, connected."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise OSError(f"--ray needs Ray ({error}); pip install 'koop[cluster]'") from error
    if os.environ.get("RAY_ADDRESS"):
        ray.init(log_to_driver=True)
        return ray
    members = (config.placement.workers or 1) + config.placement.spares
    ray.init(
        address="local",
        num_cpus=members + 1,
        include_dashboard=False,
        object_store_memory=_OBJECTS,
        _node_ip_address="127.0.0.1",
        _system_config={"worker_niceness": 0},  # else any other process goes before the service
    )
    return ray
