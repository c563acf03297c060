"""The numbers: RMSE by system, method and horizon, as rows, as CSV and as one JSON object."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from koop_service.evaluation.assessment import Result
from koop_service.evaluation.metrics import Score, score
from koop_service.evaluation.systems import HORIZONS

Results = Mapping[str, Result]

_COLUMNS = ("system", "method", "horizon", "rmse", "p10", "p50", "p90", "ratio to repeat-last")


@dataclass(frozen=True)
class Row:
    """One method's score `horizon` seconds after the fit, and its RMSE over repeat-last's."""

    system: str
    method: str
    horizon: float
    score: Score
    ratio: float


def rows(results: Results) -> Iterator[Row]:
    """Every system, method and horizon that the test sets reach."""
    for name, result in results.items():
        for method, errors in result.errors.items():
            for horizon in HORIZONS:
                frame = result.frame_at(horizon)
                if frame is not None:
                    found = score(errors, frame)
                    still = score(result.errors["repeat-last"], frame).rmse
                    yield Row(name, method, horizon, found, found.rmse / still)


def as_json(results: Results) -> dict[str, dict[str, dict[str, float]]]:
    """System -> method -> horizon in seconds -> RMSE."""
    table: dict[str, dict[str, dict[str, float]]] = {}
    for row in rows(results):
        methods = table.setdefault(row.system, {})
        methods.setdefault(row.method, {})[f"{row.horizon:g}"] = row.score.rmse
    return table


def write_csv(results: Results, path: Path) -> None:
    """Write the table to `path`."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COLUMNS)
        for row in rows(results):
            s = row.score
            numbers = (s.rmse, s.p10, s.p50, s.p90, row.ratio)
            horizon = f"{row.horizon:g}"
            writer.writerow([row.system, row.method, horizon, *(f"{x:.6g}" for x in numbers)])
