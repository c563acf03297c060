"""Colours and type of the figures: one colour a method, wherever it appears.

Offline, partial and full are red, blue and green, as in the paper.
"""

from __future__ import annotations

import itertools
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap

BACKGROUND, PANEL, LINE = "#0e1218", "#05070a", "#2b333d"
TEXT, QUIET = "#e8edf2", "#93a0ad"
DPI = 150
GREYS = LinearSegmentedColormap.from_list("greys", [PANEL, "#ffffff"])
"""Of pictures."""

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
    "once": Look("one update", "#5aa9ff"),
    "full": Look("full updates", "#4fd18b"),
    "learned-A": Look("learned A", "#f5b83d"),
    "learned-B": Look("learned B", "#f5b83d"),
    "learned-B-partial": Look("learned B, partial", "#c08a1e"),
    "learned-B-once": Look("learned B, one update", "#c08a1e"),
    "learned-B-full": Look("learned B, full", "#8f6a20"),
    "svd": Look("truncated SVD", "#c58bff"),
    "repeat-last": Look("repeat last frame", "#7d8894"),
    "repeat-period": Look("repeat last period", "#93a0ad"),
    "mean-frame": Look("mean frame", "#5f6974"),
    "previous-frame": Look("frame before", "#5f6974"),
    "period-ago": Look("frame a period ago", "#93a0ad"),
}
SERIES = ("#5aa9ff", "#ff5d5d", "#4fd18b", "#f5b83d", "#c58bff", "#5fd4d6", "#e58fb8")
"""Colours of lines that stand for systems."""


def styled() -> AbstractContextManager[None]:
    """The context in which figures are made."""
    _complete_fonts()
    return mpl.rc_context(STYLE)


@cache
def _complete_fonts() -> None:
    """Let matplotlib find the fonts that it ships, whatever its list of fonts says.

    It keeps one list for all environments of a user. Made while one of them was being installed or
    removed, the list lacks those fonts for good, and every axis with powers of ten warns of it.
    """
    known = {Path(font.fname) for font in font_manager.fontManager.ttflist}
    for path in Path(mpl.get_data_path(), "fonts", "ttf").glob("*.ttf"):
        if path not in known:
            font_manager.fontManager.addfont(path)


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
