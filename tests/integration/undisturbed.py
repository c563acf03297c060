"""What a service holds after a stream that nothing ever happened to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from koop_protocol import Control, Frame, Limits, control_key, encode, frame_key
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.serving.admission.arrivals import Arrival
from koop_service.serving.admission.news import LogQuestion
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.measurements import Measurements
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.trajectories.records import snapshot_of
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry


def arrival_of(message: Frame | Control, data: bytes | None = None) -> Arrival:
    """The message as it comes off the network."""
    key = (frame_key if isinstance(message, Frame) else control_key)(message.trajectory)
    return Arrival(key, encode(message) if data is None else data, 0)


def registry_of(model: Path, choices: EstimatorChoices, refusals: Refusals) -> Registry:
    """No trajectories yet, and this model for all of them."""
    return Registry(Catalogue([ModelEntry("model", model, ("*",))]), choices, refusals, 100)


def undisturbed(
    model: Path, messages: Iterable[Frame | Control], choices: EstimatorChoices
) -> dict[str, dict[str, Any]]:
    """The records by trajectory after these messages, one by one, from sources without a log."""
    metrics, limits = Metrics(), Limits()
    refusals = Refusals(metrics)
    registry = registry_of(model, choices, refusals)
    recovery = Recovery(registry, _nobody, metrics, limits, 1)
    measurements = Measurements(registry, refusals, recovery, metrics, limits, lambda _: None)
    for message in messages:
        plain = replace(message, logged=False) if isinstance(message, Frame) else message
        measurements.process([arrival_of(plain)])
    return {trajectory.name: snapshot_of(trajectory) for trajectory in registry}


def _nobody(question: LogQuestion) -> None:
    raise AssertionError(f"{question}: there is no log")
