"""Colours and type of the figures: one colour a method, wherever it appears.

Offline, partial and full are red, blue and green, as in the paper.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes

BACKGROUND, PANEL, LINE = "#0e1218", "#05070a", "#2b333d"
TEXT, QUIET = "#e8edf2", "#93a0ad"
DPI = 150

STYLE: Any = {
    "figure.facecolor": BACKGROUND,
    "savefig.facecolor": BACKGROUND,
    "axes.facecolor": BACKGROUND,
    "axes.edgecolor": LINE,
    "axes.labelcolor": QUIET,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": LINE,
    "grid.linewidth": 0.5,
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "text.color": TEXT,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "lines.linewidth": 1.5,
    "lines.solid_capstyle": "round",
}


@dataclass(frozen=True)
class Look:
    """How a method is named and coloured."""

    label: str
    colour: str


LOOKS = {
    "truth": Look("ground truth", TEXT),
    "reconstruction": Look("autoencoder alone", "#7d8894"),
    "offline": Look("offline", "#ff5d5d"),
    "partial": Look("partial updates", "#5aa9ff"),
    "full": Look("full updates", "#4fd18b"),
    "learned-A": Look("learned A", "#f5b83d"),
    "learned-B": Look("learned B", "#f5b83d"),
    "learned-B-partial": Look("learned B, partial", "#c08a1e"),
    "learned-B-full": Look("learned B, full", "#8f6a20"),
    "svd": Look("truncated SVD", "#c58bff"),
    "repeat-last": Look("repeat last frame", "#7d8894"),
    "mean-frame": Look("mean frame", "#5f6974"),
}
SERIES = ("#5aa9ff", "#ff5d5d", "#4fd18b", "#f5b83d", "#c58bff", "#5fd4d6", "#e58fb8")
"""Colours of lines that stand for systems."""


def spread_labels(heights: list[float], gap: float) -> list[float]:
    """Heights moved apart to at least `gap`, in their order, as little as a sweep upward can."""
    order = sorted(range(len(heights)), key=heights.__getitem__)
    placed = list(heights)
    for below, above in itertools.pairwise(order):
        placed[above] = max(placed[above], placed[below] + gap)
    return placed


def name_line(axes: Axes, right: float, height: float, label: str, colour: str) -> None:
    """A line's name at its right end, where a legend would make the eye travel."""
    axes.annotate(
        label,
        (right, height),
        (5, 0),
        textcoords="offset points",
        color=colour,
        va="center",
        annotation_clip=False,
    )
