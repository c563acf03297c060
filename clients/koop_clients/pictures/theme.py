"""Colours and type, for pictures that are read at 1000 pixels' width."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap

BACKGROUND, PANEL, LINE = "#0e1218", "#05070a", "#2b333d"
TEXT, QUIET = "#e8edf2", "#93a0ad"
TRUTH, PREDICTION, EARLY = "#f2f5f7", "#ffb000", "#d9607a"

STYLE: Any = {
    "figure.facecolor": BACKGROUND,
    "savefig.facecolor": BACKGROUND,
    "axes.facecolor": BACKGROUND,
    "axes.edgecolor": LINE,
    "axes.labelcolor": QUIET,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": LINE,
    "grid.linewidth": 0.5,
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "text.color": TEXT,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "axes.labelsize": 7.5,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
}
DPI = 200

TRUTH_MAP = LinearSegmentedColormap.from_list("truth", [PANEL, TRUTH])
PREDICTION_MAP = LinearSegmentedColormap.from_list("prediction", [PANEL, PREDICTION, "#fff3d6"])


def title(axes: Axes, text: str, explanation: str = "") -> None:
    """A heading over the left edge of `axes`, and a quieter word behind it."""
    label = axes.annotate(
        text, (0, 1), (0, 7), xycoords="axes fraction", textcoords="offset points", weight="bold"
    )
    if explanation:
        axes.annotate(
            explanation,
            (1, 0),
            (6, 0),
            xycoords=label,
            textcoords="offset points",
            va="bottom",
            color=QUIET,
        )
