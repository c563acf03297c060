"""`koop-serve`: the composition root, the only place that wires the service's parts together."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial

# The service's matrices are small, and threads for them would fight with the encoder's over the
# cores: predictions with standard deviations take ten times as long then.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torch
import zenoh

from koop_protocol import Limits
from koop_service.encoding.catalogue import Catalogue, ModelEntry, bundled_or_own
from koop_service.serving import logs
from koop_service.serving.config import ServiceConfig
from koop_service.serving.desk import Desk
from koop_service.serving.endpoint import Endpoint, put_command
from koop_service.serving.intake import Intake
from koop_service.serving.measurements import Measurements
from koop_service.serving.metrics import Metrics
from koop_service.serving.options import read_options
from koop_service.serving.outbox import Outbox
from koop_service.serving.pipeline import Pipeline
from koop_service.serving.process import limit_arenas
from koop_service.serving.questions import Question
from koop_service.serving.refusals import Refusals
from koop_service.serving.registry import Registry, settings_for
from koop_service.serving.rehearsal import rehearse
from koop_service.serving.session import UnreachableError, locators, open_session
from koop_service.serving.snapshots import SnapshotStore
from koop_service.serving.steering.commander import Commander
from koop_service.serving.steering.tasks import Tasks

log = logging.getLogger("koop.service")

_LOOK = 0.2
"""Seconds between two looks at whether a signal has come."""
_RETRY = 0.5
"""Seconds between two attempts to reach a router."""
_LAST_BATCH = 0.7
"""Seconds that a stopping service waits for the batch in work."""
_LAST_ANSWERS = 0.3
"""Seconds that a stopping service waits for its callers to take their answers."""


@dataclass(frozen=True)
class Service:
    """A running service, as its tests and the start-up line see it."""

    endpoints: list[str]
    catalogue: Catalogue
    metrics: Metrics
    metrics_port: int | None
    restored: int


def main() -> None:
    """Entry point of `koop-serve`."""
    limit_arenas()
    try:
        config = read_options(sys.argv[1:])
        logs.configure(config.monitoring.log_format, config.monitoring.log_level)
        sys.exit(serve(config))
    except (OSError, ValueError) as error:
        sys.exit(f"koop-serve: {error}")


def serve(config: ServiceConfig) -> int:
    """Run until SIGINT or SIGTERM; the exit code."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    session = _reach(config, stop)
    if session is None:
        return 0
    with session, running(config, session) as service:
        print(_greeting(service), flush=True)
        # A signal that comes to another thread, or just before the wait, does not interrupt it.
        while not stop.wait(_LOOK):
            continue
    return 0


@contextmanager
def running(config: ServiceConfig, session: zenoh.Session) -> Iterator[Service]:
    """The service on an open session, until the context ends; then its state is stored."""
    catalogue = _catalogue(config)
    torch.set_num_threads(config.compute.threads)
    metrics = Metrics()
    refusals = Refusals(metrics)
    registry = Registry(
        catalogue,
        config.estimator,
        refusals,
        config.limits.max_trajectories,
        config.compute.device,
    )
    store = SnapshotStore(config.state_folder)
    store.prepare()
    restored = registry.restore(store.load())
    _prepare(registry, catalogue, config.compute.batch)
    with ExitStack() as stack:
        pipeline = _start(config, session, registry, refusals, metrics, stack)
        port = _serve_metrics(config, metrics, stack)
        yield Service(locators(session), catalogue, metrics, port, restored)
        stack.close()
    if pipeline.finished:
        store.save(registry.snapshot())


def _start(
    config: ServiceConfig,
    session: zenoh.Session,
    registry: Registry,
    refusals: Refusals,
    metrics: Metrics,
    stack: ExitStack,
) -> Pipeline:
    """Wire intake, pipeline and outbox together; the stack takes them down in reverse order."""
    limits = config.limits
    wire = Limits(max_message_bytes=limits.max_message_bytes, max_horizon=limits.max_horizon)
    intake: Intake[Question] = Intake(
        limits.queue_messages,
        limits.queue_bytes,
        limits.queue_queries,
        metrics.held.inc,
        known=registry.__contains__,
    )
    outbox = Outbox(lambda question: _finished(question, intake, metrics), metrics.unsent.inc)
    tasks = Tasks()
    commander = Commander(tasks, registry, partial(put_command, session), metrics)
    desk = Desk(intake, registry, commander, outbox, metrics, wire)
    measurements = Measurements(registry, refusals, metrics, wire)
    pipeline = Pipeline(
        intake, measurements, desk, commander, config.compute.batch, metrics.lost.inc
    )
    _watch(metrics, intake, registry, tasks)
    outbox.start()
    stack.callback(outbox.stop, _LAST_ANSWERS)
    pipeline.start()
    stack.callback(pipeline.stop, _LAST_BATCH)
    endpoint = Endpoint(intake, metrics, limits.max_message_bytes)
    stack.enter_context(endpoint.declared(session))
    return pipeline


def _finished(question: Question, intake: Intake[Question], metrics: Metrics) -> None:
    """A question has had its last answer."""
    intake.answered(question.size)
    metrics.queries.labels(question.kind).observe(question.age())


def _watch(metrics: Metrics, intake: Intake[Question], registry: Registry, tasks: Tasks) -> None:
    metrics.watch("queue_messages", "Measurements waiting", lambda: intake.depth)
    metrics.watch("queue_queries", "Queries not answered yet", lambda: intake.unanswered)
    metrics.watch("trajectories", "Trajectories held", lambda: len(registry))
    metrics.watch("trajectories_ready", "Trajectories that can be predicted", registry.count_ready)
    metrics.watch("tasks", "Closed-loop tasks under way", lambda: len(tasks))


def _serve_metrics(config: ServiceConfig, metrics: Metrics, stack: ExitStack) -> int | None:
    settings = config.monitoring
    if settings.metrics_port is None:
        return None
    try:
        port, stop = metrics.serve(settings.metrics_port, settings.metrics_address)
    except OSError as error:
        raise OSError(
            f"metrics cannot be served on {settings.metrics_address}:{settings.metrics_port}: "
            f"{error}; choose another --metrics-port"
        ) from error
    stack.callback(stop)
    return port


def _catalogue(config: ServiceConfig) -> Catalogue:
    """The user's models before the bundled ones. Raises ValueError for a file that is no model."""
    own = [
        ModelEntry(r.name or r.path.stem, bundled_or_own(r.path), r.patterns) for r in config.models
    ]
    catalogue = Catalogue.bundled().preferring(own)
    for entry in catalogue.entries:
        settings_for(entry, config.estimator, 0)
    return catalogue


def _prepare(registry: Registry, catalogue: Catalogue, batch: int) -> None:
    """Load what the first frame would have to wait for, and keep it out of garbage collection."""
    for entry in catalogue.entries[:1]:
        rehearse(*registry.equipment(entry, control_size=1), batch)
    gc.collect()
    gc.freeze()


def _reach(config: ServiceConfig, stop: threading.Event) -> zenoh.Session | None:
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
    lines.append("  try: koop-sim-client --system cartpole    (Ctrl-C stops)")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
