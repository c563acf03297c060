"""Metrics that are looked at when somebody reads them, and where they are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from koop_service.serving.admission.intake import Intake
from koop_service.serving.admission.strain import Strain
from koop_service.serving.config import ServiceConfig
from koop_service.serving.durability.keeper import Keeper
from koop_service.serving.durability.snapshotter import Snapshotter
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.steering.tasks import Tasks
from koop_service.serving.trajectories.registry import Registry


def watch_load(
    metrics: Metrics,
    intake: Intake[Any],
    registry: Registry,
    tasks: Tasks,
    strains: Sequence[Strain],
) -> None:
    """How much is held, waits and is under way."""
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


def watch_durability(
    metrics: Metrics, recovery: Recovery, snapshotter: Snapshotter, keeper: Keeper
) -> None:
    """How far behind the logs the states are, and the disk behind the states."""
    metrics.watch("catching_up", "Trajectories catching up with a log", lambda: recovery.behind)
    metrics.watch("snapshot_age_seconds", "Age of the oldest unstored change", snapshotter.age)
    metrics.watch(
        "not_durable", "1 while states cannot be stored", lambda: float(not keeper.is_durable)
    )


def watch_encoder(metrics: Metrics, fails: Callable[[], bool]) -> None:
    """Whether pictures become codes."""
    metrics.watch(
        "encoder_fails", "1 while frames of some model cannot be encoded", lambda: float(fails())
    )


def serve_metrics(config: ServiceConfig, metrics: Metrics, stack: ExitStack) -> int | None:
    """Serve them where the settings say so, until the stack is taken down; the port.

    Raises OSError where the port cannot be had.
    """
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
