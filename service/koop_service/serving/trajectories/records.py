"""What is kept of a trajectory from one run of the service to the next, as plain values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from typing import Any

import numpy as np

from koop_protocol import checks
from koop_service.encoding.catalogue import ModelEntry
from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.estimator import Bank
from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import Stream
from koop_service.serving.trajectories.trajectory import Trajectory

_VERSION = 2
_DTYPES = {np.dtype(name).str: np.dtype(name) for name in ("uint8", "float16", "float32")}


def snapshot_of(trajectory: Trajectory) -> dict[str, Any]:
    """The record from which `restored` continues with the same bits.

    One that has learned nothing yet has no lane: a thousand that have just begun cost little.
    """
    return {
        "version": _VERSION,
        "model": trajectory.entry.name,
        "weights": trajectory.entry.fingerprint,
        "settings": _plain(trajectory.settings),
        "computed_by": trajectory.codec.computed_by,
        "epoch": trajectory.epoch,
        "predecessors": list(trajectory.predecessors),
        "dtype": trajectory.dtype.str,
        "rejected": dict(trajectory.rejected),
        "stream": trajectory.stream.snapshot(),
        "lane": trajectory.bank.snapshot(trajectory.lane) if trajectory.updates else None,
    }


def check_record(record: Mapping[str, Any], entry: ModelEntry, settings: EstimatorSettings) -> None:
    """ValueError unless the record was made by these weights and settings."""
    for name, found, wanted in (
        ("version", record["version"], _VERSION),
        ("model", record["model"], entry.name),
        ("weights", record["weights"], entry.fingerprint),
        ("settings", record["settings"], _plain(settings)),
    ):
        if found != wanted:
            raise ValueError(f"it was made with another {name}: {found}, now {wanted}")


def computed_elsewhere(record: Mapping[str, Any], codec: ImageCodec) -> str:
    """Where the record's codes were computed, if that may round otherwise than here; else ""."""
    found = record.get("computed_by", codec.computed_by)
    if found == codec.computed_by:
        return ""
    return f"their codes so far were computed by {found}, now it is {codec.computed_by}"


@cache
def _plain(settings: EstimatorSettings) -> dict[str, Any]:
    """The settings as plain values; thousands of trajectories share a few of them.

    The prior's mean is the weights', which the record names.
    """
    return {name: value for name, value in asdict(settings).items() if name != "prior_mean"}


def restored(
    name: str, record: Mapping[str, Any], entry: ModelEntry, codec: ImageCodec, bank: Bank
) -> Trajectory:
    """The trajectory of a checked record. Raises an error, and keeps no lane, if it is damaged."""
    stream = Stream.restore(bank.settings, record["stream"])
    epoch = checks.epoch("epoch", record["epoch"])
    predecessors = tuple(checks.epoch("predecessor", p) for p in record["predecessors"])
    rejected = {str(reason): int(count) for reason, count in record["rejected"].items()}
    dtype = _DTYPES[record["dtype"]]
    lane, learned = bank.open(), record["lane"]
    try:
        if learned is not None:
            bank.restore(lane, learned)
    except Exception:
        bank.close(lane)
        raise
    return Trajectory(
        name, entry, codec, bank, lane, stream, epoch, predecessors, dtype, Counter(rejected)
    )
