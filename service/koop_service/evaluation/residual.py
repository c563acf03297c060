"""The residual of the fit in code space while training: figure 17 of the paper."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from koop_service.evaluation.forecasts import Array
from koop_service.evaluation.theme import DPI, SERIES, name_line, spread_labels, styled

_SMOOTHED = 0.03  # share of the steps in the running mean that is drawn


@dataclass(frozen=True, eq=False)
class TrainingLog:
    """Steps of the second stage and the code residual at each, as koop-train wrote them."""

    steps: Array
    residual: Array


def read_log(path: Path) -> TrainingLog | None:
    """The log that koop-train left beside its weights, or None where there is nothing to draw.

    Raises ValueError where the file is not such a log.
    """
    if not path.exists():
        return None
    with path.open(newline="", encoding="utf-8") as file:
        entries = list(csv.DictReader(file))
    try:
        points = [(float(e["step"]), float(e["codes"])) for e in entries if e["codes"]]
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path} is not a log of koop-train: {error}") from error
    steps, residual = np.array(points).reshape(-1, 2).T
    known = np.isfinite(residual) & (residual > 0)
    return TrainingLog(steps[known], residual[known]) if known.sum() > 1 else None


def draw_residuals(logs: Mapping[str, TrainingLog]) -> Figure:
    """One line a system, on a logarithmic scale."""
    with styled():
        figure = Figure(figsize=(7.0, 3.5), dpi=DPI, layout="constrained")
        axes = figure.subplots()
        axes.set_yscale("log")
        ends: dict[str, float] = {}
        for (name, log), colour in zip(logs.items(), SERIES, strict=False):
            smooth = _smoothed(log.residual)
            axes.plot(log.steps, log.residual, color=colour, lw=0.6, alpha=0.25)
            axes.plot(log.steps, smooth, color=colour)
            ends[name] = float(np.log10(smooth[-1]))
        right = max(float(log.steps[-1]) for log in logs.values())
        axes.set_xlim(0, right)
        low, high = np.log10(axes.get_ylim())
        heights = spread_labels(list(ends.values()), 0.065 * float(high - low))
        for name, height, colour in zip(ends, heights, SERIES, strict=False):
            name_line(axes, right, 10**height, name, colour)
        axes.set_xlabel("training step")
        axes.set_ylabel("residual of the fit over the codes' spread")
        return figure


def _smoothed(values: Array) -> Array:
    """A centred running mean; shorter at the ends."""
    width = max(1, round(_SMOOTHED * len(values)))
    kernel = np.ones(width)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones_like(values), kernel, "same")
