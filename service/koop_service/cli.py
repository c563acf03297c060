"""`koop-serve`: from the command line to a running service, or to workers that run it."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import replace

# The service's matrices are small, and threads for them would fight with the encoder's over the
# cores: predictions with standard deviations take ten times as long then.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import zenoh

from koop_service.assembly import Service, equip, running
from koop_service.serving.config import ServiceConfig
from koop_service.serving.instruments import logs
from koop_service.serving.instruments.process import limit_arenas
from koop_service.serving.options import read_options
from koop_service.serving.placement.member import FENCED, Orders, report
from koop_service.serving.placement.supervisor import supervise
from koop_service.serving.session import UnreachableError, open_session
from koop_service.serving.sharding.settings import PlacementSettings

log = logging.getLogger("koop.service")

_LOOK = 0.2
"""Seconds between two looks at whether a signal has come."""
_RETRY = 0.5
"""Seconds between two attempts to reach a router."""


def main() -> None:
    """Entry point of `koop-serve`."""
    limit_arenas()
    try:
        config = read_options(sys.argv[1:])
        logs.configure(config.monitoring.log_format, config.monitoring.log_level)
        sys.exit(_engine(config)(config))
    except (OSError, ValueError) as error:
        sys.exit(f"koop-serve: {error}")


def _engine(config: ServiceConfig) -> Callable[[ServiceConfig], int]:
    """Who runs the service: this process, or workers that it starts."""
    if config.placement.ray:
        from koop_service.serving.placement.ray_engine import supervise_on_ray  # only if asked

        return supervise_on_ray
    return serve if config.placement.workers is None else supervise


def serve(config: ServiceConfig) -> int:
    """Run until SIGINT or SIGTERM; the exit code."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if config.placement.told_later:
        return _serve_as_told(config, stop)
    session = reach(config, stop)
    if session is None:
        return 0
    with session, running(config, session, stop=stop) as service:
        print(_greeting(service), flush=True)
        _wait_for(stop)
    return FENCED if service.keeper.is_fenced else 0


def _wait_for(stop: threading.Event) -> None:
    """Until a signal has come: one to another thread, or just before a wait, ends no wait."""
    while not stop.wait(_LOOK):
        continue


def _serve_as_told(config: ServiceConfig, stop: threading.Event) -> int:
    """Load everything, and serve once a supervisor has said which worker this is to be."""
    equipment = equip(config)
    told = _told(config, stop)
    session = None if told is None else reach(told, stop)
    if told is None or session is None:
        return 0
    with session, running(told, session, equipment, stop) as service:
        worker, port = told.placement.worker, service.metrics_port
        report("ready", worker=worker, metrics_port=port, restored=service.restored)
        _wait_for(stop)
    return FENCED if service.keeper.is_fenced else 0


def _told(config: ServiceConfig, stop: threading.Event) -> ServiceConfig | None:
    """The settings of the worker that the supervisor's line names; None if it says stop."""
    orders = Orders(stop)
    report("prepared")
    worker = orders.next()
    if worker is None:
        return None
    port = config.monitoring.metrics_port
    if port:  # a port for each
        port += int(worker.split("/")[0])
    monitoring = replace(config.monitoring, metrics_port=port)
    logs.configure(monitoring.log_format, monitoring.log_level, worker)
    return replace(config, placement=PlacementSettings(worker=worker), monitoring=monitoring)


def reach(config: ServiceConfig, stop: threading.Event) -> zenoh.Session | None:
    """Open the session; where there is nothing to connect to yet, wait for it (None: stopped)."""
    told = False
    while not stop.is_set():
        try:
            return open_session(config.network)
        except UnreachableError as error:
            if not told:
                log.info("%s; waiting for it", error)
            told = True
            stop.wait(_RETRY)
    return None


def _greeting(service: Service) -> str:
    models = ", ".join(f"{e.name} ({' '.join(e.patterns)})" for e in service.catalogue.entries)
    where = ", ".join(service.endpoints) or "the routers it is connected to"
    lines = [
        f"koop-serve is ready on {where}",
        f"  models: {models or 'none yet; train one with koop-train'}",
    ]
    if service.restored:
        lines.append(f"  trajectories continued from the last run: {service.restored}")
    if service.metrics_port is not None:
        lines.append(f"  metrics: port {service.metrics_port}, /metrics")
    how = " --zenoh-config FILE" if "tls/" in where else ""
    lines.append(f"  try: koop-sim-client --system cartpole{how}    (Ctrl-C stops)")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
