"""A soak in one figure: memory, latency, throughput, and what was lost."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from soaking.verdict import Sample

from koop_service.evaluation.theme import DPI, QUIET, SERIES, styled

mpl.use("Agg")
from matplotlib import pyplot as plt

BUCKETS = 120
"""Most points of a latency line."""


def draw(path: Path, samples: list[Sample], latencies: list[tuple[float, float]]) -> None:
    """latencies: (when asked, how long it took) [s], by the clock of the samples."""
    with styled():
        figure, axes = plt.subplots(4, 1, figsize=(7, 7), sharex=True, layout="constrained")
        start = samples[0].at
        minutes = np.array([sample.at - start for sample in samples]) / 60
        _memory(axes[0], minutes, samples)
        _latency(axes[1], start, latencies)
        _throughput(axes[2], minutes, samples)
        _loss(axes[3], minutes, samples)
        axes[-1].set_xlabel("minutes")
        figure.savefig(path, dpi=DPI)
        plt.close(figure)


def _memory(axes: Axes, minutes: np.ndarray, samples: list[Sample]) -> None:
    axes.plot(minutes, [sample.resident / 1e6 for sample in samples], color=SERIES[0])
    _finish(axes, "resident [MB]")


def _latency(axes: Axes, start: float, latencies: list[tuple[float, float]]) -> None:
    if not latencies:
        return
    at = np.array([time - start for time, _ in latencies]) / 60
    took = 1e3 * np.array([latency for _, latency in latencies])
    edges = np.linspace(at.min(), at.max() + 1e-9, min(BUCKETS, 1 + len(took) // 100) + 1)
    bucket = np.digitize(at, edges)
    for share, colour in ((50, SERIES[2]), (99, SERIES[3])):
        points = [(edges[i - 1], np.percentile(took[bucket == i], share)) for i in set(bucket)]
        x, y = zip(*sorted(points), strict=True)
        axes.plot(x, y, color=colour, label=f"p{share}", marker="." if len(x) < 3 else "")
    _finish(axes, "prediction [ms]")
    _name_lines(axes)


def _throughput(axes: Axes, minutes: np.ndarray, samples: list[Sample]) -> None:
    seconds = np.maximum(np.diff(60 * minutes), 1e-9)
    for name, colour in (("frames", SERIES[0]), ("rejected", SERIES[1])):
        counts = np.diff([getattr(sample, name) for sample in samples])
        axes.plot(minutes[1:], counts / seconds, color=colour, label=name)
    _finish(axes, "a second")
    _name_lines(axes)


def _loss(axes: Axes, minutes: np.ndarray, samples: list[Sample]) -> None:
    axes.plot(minutes, [sample.waiting for sample in samples], color=QUIET, label="waiting")
    axes.plot(minutes, [sample.lost for sample in samples], color=SERIES[1], label="lost")
    _finish(axes, "messages")
    _name_lines(axes)


def _finish(axes: Axes, label: str) -> None:
    """From zero, so that a change looks as large as it is."""
    axes.set_ylim(0, 1.1 * max(axes.get_ylim()[1], 1e-3))
    axes.set_ylabel(label)


def _name_lines(axes: Axes) -> None:
    """Above the panel, where no line runs."""
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98), "borderaxespad": 0.0}
    axes.legend(frameon=False, labelcolor=QUIET, ncols=2, **place)
