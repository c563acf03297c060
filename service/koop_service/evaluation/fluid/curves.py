"""L1 over time: figure 14 of the paper, and the same at Reynolds numbers training has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from koop_service.evaluation.fluid.assessment import Judged
from koop_service.evaluation.fluid.cases import FIT_FRAMES, UPDATE_AT
from koop_service.evaluation.fluid.table import OVERLAPPING, Results, by_reynolds
from koop_service.evaluation.forecasts import Array
from koop_service.evaluation.metrics import PERCENTILES
from koop_service.evaluation.theme import DPI, LOOKS, QUIET, TEXT, name_line, spread_labels, styled

OURS = ("offline", "once", "full")
_GUESSES = ("repeat-last", "repeat-period", "period-ago")
_ALL = (*OURS, "learned-A", "learned-B", *_GUESSES)
_FEW = (*OURS, "learned-A", "learned-B", "repeat-last")
_UNIT = "L1 [standard deviations of a channel]"
_FLOOR = 1e-4  # what half precision resolves; a guess of a steady flow can be exact
_ROOM = 1.25  # factor beyond the lowest and the highest line
_LABEL_GAP = 0.055  # of the panel's height
_LATE = 9  # frames at the end whose mean places a line's name: a shedding period


def draw_curves(results: Results) -> Figure:
    """Figure 14: a panel a wake, side by side, each on its own scale."""
    panels = [splits[OVERLAPPING] for splits in results.values()]
    with styled():
        figure = Figure(figsize=(5.6 * len(panels), 4.2), dpi=DPI, layout="constrained")
        grid = figure.subplots(1, len(panels), squeeze=False)
        for axes, judged in zip(grid[0], panels, strict=True):
            methods = [method for method in _ALL if method in judged.errors]
            _scale(axes, [judged], methods)
            _draw(axes, judged, methods)
            _name_lines(axes, judged, methods)
            _head(axes, judged, f"{judged.case.wake.title}, {judged.sequences} sequences")
        grid[0, 0].set_ylabel(_UNIT)
        return figure


def draw_held_out(results: Results) -> Figure:
    """A row a wake, a column a Reynolds number; sequences that share no frame."""
    rows = [by_reynolds(splits) for splits in results.values()]
    columns = max(len(row) for row in rows)
    with styled():
        size = (3.6 * columns + 0.8, 3.3 * len(rows))
        figure = Figure(figsize=size, dpi=DPI, layout="constrained")
        grid = figure.subplots(len(rows), columns, sharey="row", squeeze=False)
        for panels, row in zip(grid, rows, strict=True):
            methods = [method for method in _FEW if method in row[0].errors]
            _scale(panels[0], row, methods)
            for axes, judged in zip(panels, row, strict=True):
                _draw(axes, judged, methods)
                _head(axes, judged, _flow(judged))
            _name_lines(panels[-1], row[-1], methods)
            panels[0].set_ylabel(_UNIT)
        return figure


def _flow(judged: Judged) -> str:
    case = judged.case
    known = "not trained on" if case.held_out else "as trained"
    return f"{case.wake.title}, Re {case.reynolds:g}: {known}"


def _scale(axes: Axes, all_of: Sequence[Judged], methods: Sequence[str]) -> None:
    """A logarithmic one that holds every line after the fit."""
    curves = [_curve(judged, method)[FIT_FRAMES:] for judged in all_of for method in methods]
    axes.set_yscale("log")
    axes.set_ylim(np.min(curves) / _ROOM, np.max(curves) * _ROOM)


def _curve(judged: Judged, method: str) -> Array:
    return np.maximum(judged.curve(method), _FLOOR)


def _draw(axes: Axes, judged: Judged, methods: Sequence[str]) -> None:
    times = np.arange(len(judged.curve("offline"))) * judged.dt
    for method in methods:
        colour, guess = LOOKS[method].colour, method in _GUESSES
        known = slice(FIT_FRAMES - 1, None) if guess else slice(None)
        if method in ("offline", "full"):
            low, _, high = np.percentile(judged.l1(method), PERCENTILES, axis=0)
            axes.fill_between(times, low, high, color=colour, alpha=0.11, lw=0)
        width, dashes = (1.0, (0, (3, 2))) if guess else (1.5, "-")
        curve = _curve(judged, method)
        axes.plot(times[known], curve[known], color=colour, lw=width, ls=dashes, zorder=3)
    for frames, name in ((FIT_FRAMES, "fit "), (UPDATE_AT, "update ")):
        _mark(axes, (frames - 1) * judged.dt, name)
    axes.set_xlim(0, times[-1])
    axes.set_xlabel("time, in the paper's label [s]")


def _name_lines(axes: Axes, judged: Judged, methods: Sequence[str]) -> None:
    low, high = np.log10(axes.get_ylim())
    ends = [float(np.log10(_curve(judged, method)[-_LATE:].mean())) for method in methods]
    right = axes.get_xlim()[1]
    for method, height in zip(methods, spread_labels(ends, _LABEL_GAP * (high - low)), strict=True):
        name_line(axes, right, 10**height, LOOKS[method].label, LOOKS[method].colour)


def _head(axes: Axes, judged: Judged, title: str) -> None:
    """The title, and the flow's own time on the upper edge."""
    axes.set_title(title, loc="left", color=TEXT, fontsize=8.5)
    unit = judged.units.frame_time / judged.dt
    upper = axes.secondary_xaxis(
        "top", functions=(partial(np.multiply, unit), partial(np.multiply, 1 / unit))
    )
    upper.set_xlabel("flow's own time [D/U]", color=QUIET, fontsize=7.5)
    upper.tick_params(labelsize=7)


def _mark(axes: Axes, time: float, name: str) -> None:
    axes.axvline(time, color=QUIET, lw=0.9, ls=(0, (4, 3)), zorder=1)
    axes.annotate(
        name,
        (time, 1),
        (-1, -9),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        color=QUIET,
        ha="right",
        fontsize=7,
    )
