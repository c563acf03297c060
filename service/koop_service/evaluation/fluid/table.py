"""The numbers: L1 by wake, split, method, channel and horizon, as rows, as CSV, as one JSON object.

A split is a choice of test sequences of a wake: "overlapping" (the paper's), "apart" (the same, but
only such as share no frame), and each Reynolds number that training has not seen.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from koop_service.evaluation.fluid.assessment import Judged
from koop_service.evaluation.fluid.cases import FIT_FRAMES
from koop_service.evaluation.forecasts import Array
from koop_service.evaluation.metrics import PERCENTILES

Splits = Mapping[str, Judged]
Results = Mapping[str, Splits]
"""Wake -> split -> what was found."""

OVERLAPPING, APART = "overlapping", "apart"
HORIZONS = (1, 10, 50, 100)
"""Frames after the fit that are told, besides the mean over all."""
MEAN, ALL = "mean", "all"
_COLUMNS = ("system", "split", "method", "channel", "horizon", "L1", "p10", "p50", "p90",
            "ratio to repeat-last")  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One method's L1 in one channel (or ALL) `horizon` seconds after the fit, or their MEAN.

    Percentiles 10, 50, 90 of the sequences' own, and the ratio to repeat-last's.
    """

    system: str
    split: str
    method: str
    channel: str
    horizon: str
    l1: float
    percentiles: tuple[float, float, float]
    ratio: float


def reached(judged: Judged) -> list[int]:
    """The horizons [frames] that the sequences reach."""
    length = judged.curve("offline").size
    return [k for k in HORIZONS if FIT_FRAMES - 1 + k < length]


def rows(results: Results) -> Iterator[Row]:
    """Everything."""
    for wake, splits in results.items():
        for split, judged in splits.items():
            for method in judged.errors:
                for channel in (ALL, *judged.units.channels):
                    yield from _rows(wake, split, judged, method, channel)


def as_json(results: Results) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """System -> split -> method -> horizon in seconds, and "mean" -> L1 over all channels.

    And "visible" -> share of the last frame's pixels that err visibly.
    """
    table: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for row in rows(results):
        if row.channel == ALL:
            methods = table.setdefault(row.system, {}).setdefault(row.split, {})
            methods.setdefault(row.method, {})[row.horizon] = row.l1
    for wake, splits in results.items():
        for split, judged in splits.items():
            for method, errors in judged.errors.items():
                table[wake][split][method]["visible"] = float(errors.visible[:, -1].mean())
    return table


def write_csv(results: Results, path: Path) -> None:
    """Write the table to `path`."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COLUMNS)
        for row in rows(results):
            names = (row.system, row.split, row.method, row.channel, row.horizon)
            numbers = (row.l1, *row.percentiles, row.ratio)
            writer.writerow([*names, *(f"{x:.6g}" for x in numbers)])


def by_reynolds(splits: Splits) -> list[Judged]:
    """Those whose sequences share no frame, by rising Reynolds number."""
    found = [judged for name, judged in splits.items() if name != OVERLAPPING]
    return sorted(found, key=lambda judged: judged.case.reynolds)


def own(judged: Judged, method: str, channel: str) -> Array:
    """(N, T) L1 of each sequence in one channel, or ALL."""
    if channel == ALL:
        return judged.l1(method)
    return judged.errors[method].absolute[..., judged.units.channels.index(channel)]


def _rows(wake: str, split: str, judged: Judged, method: str, channel: str) -> Iterator[Row]:
    found, still = (own(judged, name, channel) for name in (method, "repeat-last"))
    for horizon, moment in _moments(judged).items():
        each = found[:, moment].mean(1)
        low, middle, high = np.percentile(each, PERCENTILES).tolist()
        l1 = float(each.mean())
        ratio = l1 / float(still[:, moment].mean())
        yield Row(wake, split, method, channel, horizon, l1, (low, middle, high), ratio)


def _moments(judged: Judged) -> dict[str, slice]:
    """The frames of each horizon, by its name."""
    at = {f"{k * judged.dt:g}": FIT_FRAMES - 1 + k for k in reached(judged)}
    moments = {horizon: slice(frame, frame + 1) for horizon, frame in at.items()}
    return moments | {MEAN: slice(FIT_FRAMES, None)}
