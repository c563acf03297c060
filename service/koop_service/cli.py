"""`koop-serve`: the composition root, the only place that wires the service's parts together."""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial

# The service's matrices are small, and threads for them would fight with the encoder's over the
# cores: predictions with standard deviations take ten times as long then.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torch
import zenoh

from koop_protocol import CATCHING_UP, NOT_DURABLE, Limits
from koop_service.encoding.catalogue import Catalogue, ModelEntry, bundled_or_own
from koop_service.serving import logs
from koop_service.serving.config import ServiceConfig
from koop_service.serving.desk import Desk
from koop_service.serving.durability.archive import Archive
from koop_service.serving.durability.keeper import Keeper
from koop_service.serving.durability.log_reader import LogReader
from koop_service.serving.durability.opening import claim_and_load, open_store
from koop_service.serving.durability.recovery import Recovery
from koop_service.serving.durability.snapshotter import Snapshotter
from koop_service.serving.endings import Endings
from koop_service.serving.endpoint import Endpoint, put_command, put_durable, put_notice
from koop_service.serving.equipment import settings_for
from koop_service.serving.eviction import Eviction
from koop_service.serving.intake import Intake
from koop_service.serving.measurements import Measurements
from koop_service.serving.memory import Memory
from koop_service.serving.metrics import Metrics
from koop_service.serving.options import read_options
from koop_service.serving.outbox import Outbox
from koop_service.serving.pace import Pace
from koop_service.serving.pipeline import Pipeline
from koop_service.serving.placement.member import FENCED, Orders, report
from koop_service.serving.placement.ownership import Ownership
from koop_service.serving.placement.settings import PlacementSettings
from koop_service.serving.placement.supervisor import supervise
from koop_service.serving.process import limit_arenas
from koop_service.serving.questions import Question
from koop_service.serving.refusals import Refusals
from koop_service.serving.registry import Registry
from koop_service.serving.rehearsal import rehearse
from koop_service.serving.replies import Replies
from koop_service.serving.session import UnreachableError, locators, open_session
from koop_service.serving.shedding import Shedding
from koop_service.serving.steering.commander import Commander
from koop_service.serving.steering.tasks import Tasks
from koop_service.serving.strain import MEMORY, QUEUE, Strain
from koop_service.serving.vitals import Vitals, worker_name
from koop_service.serving.watchdog import Watchdog, give_up

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
    keeper: Keeper


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


@dataclass(frozen=True)
class Equipment:
    """All that takes its time to load, and does not depend on the shards."""

    catalogue: Catalogue
    metrics: Metrics
    refusals: Refusals
    registry: Registry


def equip(config: ServiceConfig) -> Equipment:
    """Load the models, and do everything once, so that nobody waits for it later."""
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
    _prepare(registry, catalogue, config.compute.batch)
    return Equipment(catalogue, metrics, refusals, registry)


@contextmanager
def running(
    config: ServiceConfig,
    session: zenoh.Session,
    equipment: Equipment | None = None,
    stop: threading.Event | None = None,
) -> Iterator[Service]:
    """The service on an open session, until the context ends; then its state is stored.

    `stop` ends the wait for a store that is away, with SystemExit; it is set when somebody else has
    claimed this service's shards.
    """
    kit, stop = equipment or equip(config), stop or threading.Event()
    ownership = config.placement.ownership()
    with closing(open_store(config)) as store:
        owner, most = f"koop-serve {worker_name()}", config.limits.max_trajectories
        taken = claim_and_load(store, owner, ownership.shards, most, stop)
        if taken is None:
            sys.exit(0)
        claim, records = taken
        restored = kit.registry.restore(records)
        gc.freeze()  # what was restored lives long, too
        keeper = Keeper(store, claim, partial(put_durable, session), kit.metrics, stop.set)
        with ExitStack() as stack:
            keeper.start()
            stack.callback(keeper.stop)
            archive = Archive(store.find)
            with _started(config, session, kit, ownership, keeper, archive):
                port = _serve_metrics(config, kit.metrics, stack)
                where = locators(session)
                yield Service(where, kit.catalogue, kit.metrics, port, restored, keeper)


@contextmanager
def _started(
    config: ServiceConfig,
    session: zenoh.Session,
    kit: Equipment,
    ownership: Ownership,
    keeper: Keeper,
    archive: Archive,
) -> Iterator[None]:
    """Intake, pipeline, outbox and all that they need, wired together; then the last snapshots."""
    registry, metrics, limits = kit.registry, kit.metrics, config.limits
    wire = Limits(max_message_bytes=limits.max_message_bytes, max_horizon=limits.max_horizon)
    replies = replace(wire, max_message_bytes=limits.max_reply_bytes)
    intake: Intake[Question] = Intake(
        limits.queue_messages,
        limits.queue_bytes,
        limits.queue_queries,
        metrics.held.inc,
        known=registry.__contains__,
    )
    outbox = Outbox(
        lambda question: _finished(question, intake, metrics),
        metrics.unsent.inc,
        2 * limits.max_reply_bytes,
    )
    reader = LogReader(session, intake.tell, wire.for_replays().max_message_bytes)
    recovery = Recovery(registry, reader.ask, metrics, wire, 2 * limits.max_trajectories)
    every = config.durability.snapshot_every
    snapshotter = Snapshotter(registry, keeper, archive, recovery.is_logged, every)
    tasks = Tasks()
    commander = Commander(tasks, registry, partial(put_command, session), metrics)
    queue, memory = Strain(QUEUE, metrics), Memory(limits.max_memory, Strain(MEMORY, metrics))
    eviction = Eviction(
        registry,
        snapshotter,
        metrics,
        limits.evict_after,
        lambda name: tasks.find(name) is not None,
        lambda: memory.strain.active,
    )
    registry.ended = Endings(partial(put_notice, session)).tell
    vitals = Vitals(worker_name(), intake, registry, queue, memory)
    vitals.watch(NOT_DURABLE, lambda: not keeper.is_durable)
    vitals.watch(CATCHING_UP, lambda: recovery.behind > 0)
    strains = (queue, memory.strain)
    understood = Replies(commander, wire, replies)
    shedding = Shedding(understood, strains)
    desk = Desk(
        intake, registry, understood, recovery, outbox, metrics, vitals, shedding, ownership
    )
    measurements = Measurements(registry, kit.refusals, recovery, metrics, wire, snapshotter.note)
    pipeline = Pipeline(
        intake,
        measurements,
        desk,
        commander,
        vitals,
        recovery,
        snapshotter,
        eviction,
        config.compute.batch,
        metrics.lost.inc,
    )
    _watch(metrics, intake, registry, tasks, strains)
    _watch_durability(metrics, recovery, snapshotter, keeper)
    pace = Pace(limits.max_query_rate)
    endpoint = Endpoint(intake, metrics, limits.max_message_bytes, pace, shedding, ownership)
    with ExitStack() as stack:
        outbox.start()
        stack.callback(outbox.stop, _LAST_ANSWERS)
        reader.start()
        stack.callback(reader.stop, _LAST_ANSWERS)
        pipeline.start()
        stack.callback(pipeline.stop, _LAST_BATCH)
        _guard(config, vitals, metrics, stack)
        stack.enter_context(endpoint.declared(session))
        yield
    if pipeline.finished:
        snapshotter.finish()


def _finished(question: Question, intake: Intake[Question], metrics: Metrics) -> None:
    """A question has had its last answer."""
    intake.answered(question.size, question.kind)
    metrics.queries.labels(question.kind).observe(question.age())


def _guard(config: ServiceConfig, vitals: Vitals, metrics: Metrics, stack: ExitStack) -> None:
    """Have a watchdog look after the pipeline."""
    patience, exits = config.monitoring.stuck_after, config.monitoring.exit_when_stuck
    if patience:
        stuck = give_up(exits, patience, metrics.stuck.inc)
        watchdog = Watchdog(lambda: vitals.turns, patience, stuck, exits)
        watchdog.start()
        stack.callback(watchdog.stop)


def _watch(
    metrics: Metrics,
    intake: Intake[Question],
    registry: Registry,
    tasks: Tasks,
    strains: Sequence[Strain],
) -> None:
    for strain in strains:
        word, cause = strain.kind.word, strain.kind.cause
        metrics.watch(word, f"Whether {cause}", partial(_is_active, strain))
    metrics.watch("queue_messages", "Measurements waiting", lambda: intake.depth)
    metrics.watch("queue_queries", "Queries not answered yet", lambda: intake.unanswered)
    metrics.watch("trajectories", "Trajectories held", lambda: len(registry))
    metrics.watch("trajectories_ready", "Trajectories that can be predicted", registry.count_ready)
    metrics.watch("tasks", "Closed-loop tasks under way", lambda: len(tasks))


def _is_active(strain: Strain) -> float:
    return float(strain.active)


def _watch_durability(
    metrics: Metrics, recovery: Recovery, snapshotter: Snapshotter, keeper: Keeper
) -> None:
    metrics.watch("catching_up", "Trajectories catching up with a log", lambda: recovery.behind)
    metrics.watch("snapshot_age_seconds", "Age of the oldest unstored change", snapshotter.age)
    metrics.watch(
        "not_durable", "1 while states cannot be stored", lambda: float(not keeper.is_durable)
    )


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
