"""The service's parts wired together: the only place that knows them all."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial

import torch
import zenoh

from koop_protocol import CATCHING_UP, ENCODER_FAILS, NOT_DURABLE, Limits
from koop_service.encoding.catalogue import Catalogue, ModelEntry, bundled_or_own
from koop_service.serving.admission.intake import Intake
from koop_service.serving.admission.pace import Pace
from koop_service.serving.admission.strain import MEMORY, QUEUE, Strain
from koop_service.serving.answering.desk import Desk
from koop_service.serving.answering.outbox import Outbox
from koop_service.serving.answering.questions import Question
from koop_service.serving.answering.replies import Replies
from koop_service.serving.answering.shedding import Shedding
from koop_service.serving.config import ServiceConfig
from koop_service.serving.durability.archive import Archive
from koop_service.serving.durability.eviction import Eviction
from koop_service.serving.durability.keeper import Keeper
from koop_service.serving.durability.opening import claim_and_load, open_store
from koop_service.serving.durability.retention import Retention
from koop_service.serving.durability.snapshotter import Snapshotter
from koop_service.serving.endpoint import Endpoint, put_command, put_durable, put_notice
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.measurements import Measurements
from koop_service.serving.monitoring.collector import settle, sparing
from koop_service.serving.monitoring.gauges import (
    serve_metrics,
    watch_durability,
    watch_encoder,
    watch_load,
)
from koop_service.serving.monitoring.memory import Memory
from koop_service.serving.monitoring.vitals import Vitals, worker_name
from koop_service.serving.monitoring.watchdog import Watchdog, give_up
from koop_service.serving.pipeline import Pipeline
from koop_service.serving.rehearsal import rehearse
from koop_service.serving.replay.log_reader import LogReader
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.session import locators
from koop_service.serving.sharding.ownership import Ownership
from koop_service.serving.steering.commander import Commander
from koop_service.serving.steering.tasks import Tasks
from koop_service.serving.trajectories.endings import Endings
from koop_service.serving.trajectories.equipment import settings_for
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry

_DAY = 86400.0
"""Seconds."""
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
    _prepare(registry, catalogue)
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
        after = _DAY * config.durability.forget_after
        retention = Retention(store, claim, after, kit.registry.__contains__, kit.metrics)
        put = partial(put_durable, session)
        keeper = Keeper(store, claim, put, kit.metrics, stop.set, retention)
        with sparing(), ExitStack() as stack:
            keeper.start()
            stack.callback(keeper.stop)
            archive = Archive(store.find)
            with _started(config, session, kit, ownership, keeper, archive):
                port = serve_metrics(config, kit.metrics, stack)
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
    vitals.watch(ENCODER_FAILS, lambda: measurements.encoder_fails)
    watch_encoder(metrics, lambda: measurements.encoder_fails)
    watch_load(metrics, intake, registry, tasks, strains)
    watch_durability(metrics, recovery, snapshotter, keeper)
    pace = Pace(limits.max_query_rate)
    endpoint = Endpoint(intake, metrics, limits.max_message_bytes, pace, shedding, ownership)
    with ExitStack() as stack:
        outbox.start()
        stack.callback(outbox.stop, _LAST_ANSWERS)
        pipeline.start()
        stack.callback(pipeline.stop, _LAST_BATCH)
        _guard(config, vitals, measurements, metrics, stack)
        stack.enter_context(endpoint.declared(session))
        # After that: what a source puts once it was asked must find us listening.
        reader.start()
        stack.callback(reader.stop, _LAST_ANSWERS)
        yield
    if pipeline.finished:
        snapshotter.finish()


def _finished(question: Question, intake: Intake[Question], metrics: Metrics) -> None:
    """A question has had its last answer."""
    intake.answered(question.size, question.kind)
    metrics.queries.labels(question.kind).observe(question.age())


def _guard(
    config: ServiceConfig,
    vitals: Vitals,
    measurements: Measurements,
    metrics: Metrics,
    stack: ExitStack,
) -> None:
    """Have a watchdog look after the pipeline; who can encode nothing might as well not turn."""

    def fails() -> bool:
        return measurements.encoder_fails

    def turns() -> int:
        return -1 if fails() else vitals.turns

    patience, exits = config.monitoring.stuck_after, config.monitoring.exit_when_stuck
    if patience:
        stuck = give_up(exits, patience, metrics.stuck.inc, fails)
        watchdog = Watchdog(turns, patience, stuck, exits)
        watchdog.start()
        stack.callback(watchdog.stop)


def _catalogue(config: ServiceConfig) -> Catalogue:
    """The user's models before the bundled ones. Raises ValueError for a file that is no model."""
    own = [
        ModelEntry(r.name or r.path.stem, bundled_or_own(r.path), r.patterns) for r in config.models
    ]
    catalogue = Catalogue.bundled().preferring(own)
    for entry in catalogue.entries:
        settings_for(entry, config.estimator, 0)
    return catalogue


def _prepare(registry: Registry, catalogue: Catalogue) -> None:
    """Load what the first frame would have to wait for."""
    for entry in catalogue.entries[:1]:
        rehearse(*registry.equipment(entry, control_size=1))
    settle()
