"""Strips of pictures: figures 2 and 7 to 11 of the paper.

The left block holds the first predicted frames, the right one the frames 30 steps later.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from koop_service.evaluation.assessment import Result
from koop_service.evaluation.theme import DPI, GREYS, LOOKS, QUIET, TEXT, styled

COLUMNS, LATER = 8, 30  # frames in a block; steps from the first block to the second

_WIDTH, _LABELS, _GAP, _HEADING, _FOOT = 11.0, 1.25, 0.2, 0.5, 0.05  # inches
_SEPARATOR = 2  # pixels between pictures


def draw_strip(result: Result, methods: Sequence[str]) -> Figure:
    """Truth above each method's pictures of one trajectory."""
    rows = ["truth", *(m for m in methods if m in result.strip)]
    block = (_WIDTH - _LABELS - _GAP - _FOOT) / 2
    tall = block * len(rows) / COLUMNS
    height = _HEADING + tall + _FOOT
    with styled():
        figure = Figure(figsize=(_WIDTH, height), dpi=DPI)
        for i, after in enumerate((0, LATER)):
            left = _LABELS + i * (block + _GAP)
            box = (left / _WIDTH, _FOOT / height, block / _WIDTH, tall / height)
            axes = figure.add_axes(box)
            _block(axes, result, rows, after)
            if i == 0:
                _name_rows(axes, rows)
        _head(figure, result, height)
        return figure


def _block(axes: Axes, result: Result, rows: Sequence[str], after: int) -> None:
    first = result.system.fit_frames + after
    pictures = np.stack([result.strip[row][first : first + COLUMNS] for row in rows])
    axes.imshow(mosaic(pictures), cmap=GREYS, vmin=0, vmax=255, aspect="auto")
    axes.set_axis_off()
    begin, end = ((after + k) * result.dt for k in (1, COLUMNS))
    axes.annotate(
        f"{begin:.2f} to {end:.2f} s after the fit",
        (0, 1),
        (0, 4),
        xycoords="axes fraction",
        textcoords="offset points",
        color=QUIET,
    )


def mosaic(pictures: NDArray[np.uint8]) -> NDArray[np.float64]:
    """One masked picture of (rows, columns, H, W), with gaps between."""
    rows, columns, height, width = pictures.shape
    tile = (height + _SEPARATOR, width + _SEPARATOR)
    sheet = np.full((rows, columns, *tile), np.nan)
    sheet[:, :, :height, :width] = pictures
    joined = sheet.swapaxes(1, 2).reshape(rows * tile[0], columns * tile[1])
    return np.ma.masked_invalid(joined)


def _name_rows(axes: Axes, rows: Sequence[str]) -> None:
    for i, row in enumerate(rows):
        look = LOOKS[row]
        axes.annotate(
            look.label,
            (0, 1 - (i + 0.5) / len(rows)),
            (-8, 0),
            xycoords="axes fraction",
            textcoords="offset points",
            color=look.colour,
            ha="right",
            va="center",
        )


def _head(figure: Figure, result: Result, height: float) -> None:
    text = f"{result.system.title}: the trajectory of median offline error"
    figure.text(_LABELS / _WIDTH, 1 - 0.17 / height, text, color=TEXT, va="center", weight="bold")
