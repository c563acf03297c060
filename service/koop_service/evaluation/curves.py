"""RMSE over time: figures 3, 4, 5 and 12 of the paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from koop_service.evaluation.assessment import Result
from koop_service.evaluation.metrics import spread_over_time
from koop_service.evaluation.theme import DPI, LOOKS, QUIET, TEXT, name_line, spread_labels, styled

_LABEL_GAP = 0.065  # of the panel's height

Panel = tuple[Result, Sequence[str]]
"""A system and the methods to draw, those that it was judged by."""


def draw_curves(panels: Sequence[Panel]) -> Figure:
    """One panel a system, side by side, each on its own scale."""
    with styled():
        figure = Figure(figsize=(5.6 * len(panels), 3.5), dpi=DPI, layout="constrained")
        all_axes = np.atleast_1d(figure.subplots(1, len(panels))).tolist()
        for axes, (result, methods) in zip(all_axes, panels, strict=True):
            _panel(axes, result, [m for m in methods if m in result.errors])
        all_axes[0].set_ylabel("RMSE per pixel, pixels in [0, 1]")
        return figure


def _panel(axes: Axes, result: Result, methods: Sequence[str]) -> None:
    times = np.arange(result.system.frames) * result.dt
    first = result.system.fit_frames - 1
    # The means decide the scale, not the bands: one trajectory that diverges would flatten them.
    axes.set_ylim(0, 1.12 * max(float(result.rmse(method).max()) for method in methods))
    for method in methods:
        curve, colour = result.rmse(method), LOOKS[method].colour
        if method != "partial":  # a saw's band would hide the others
            low, _, high = spread_over_time(result.errors[method])[:, first:]
            axes.fill_between(times[first:], low, high, color=colour, alpha=0.11, lw=0)
        axes.plot(times, curve, color=colour, zorder=3)
    _name_lines(axes, result, methods, times[-1])
    _mark(axes, first * result.dt, "fit ", "right")
    if result.trained_frames:
        _mark(axes, result.trained_frames * result.dt, " training", "left")
    axes.set_xlim(0, times[-1])
    axes.set_xlabel("time [s]")
    axes.set_title(
        f"{result.system.title}, {result.trajectories} trajectories",
        loc="left",
        color=TEXT,
        fontsize=8.5,
        pad=14,
    )


def _name_lines(axes: Axes, result: Result, methods: Sequence[str], right: float) -> None:
    top = axes.get_ylim()[1]
    # Over the last second: a line of partial updates is a saw.
    ends = [float(result.rmse(method)[-20:].mean()) for method in methods]
    heights = spread_labels(ends, _LABEL_GAP * top)
    for method, height in zip(methods, heights, strict=True):
        name_line(axes, right, height, LOOKS[method].label, LOOKS[method].colour)


def _mark(axes: Axes, time: float, name: str, side: str) -> None:
    axes.axvline(time, color=QUIET, lw=0.9, ls=(0, (4, 3)), zorder=1)
    axes.annotate(
        name,
        (time, 1),
        (0, 2),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        color=QUIET,
        ha=side,
        va="bottom",
        fontsize=7,
    )
