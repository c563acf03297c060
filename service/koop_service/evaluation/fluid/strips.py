"""Pictures of x-momentum: figure 15 of the paper, beside the truth and the difference."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle

from koop_service.evaluation.fluid.assessment import SHOWN, Judged
from koop_service.evaluation.fluid.errors import COLOURS
from koop_service.evaluation.theme import DPI, PANEL, QUIET, TEXT, styled

MAGNIFIED = 5
"""The colours of a difference span this much less than those of the fields."""

_SPAN = (COLOURS[1] - COLOURS[0]) / MAGNIFIED / 2
# What the cylinder slows down glows; a difference is black where there is none.
_FIELD = {"cmap": colormaps["magma_r"], "vmin": COLOURS[0], "vmax": COLOURS[1]}
_DIFFERENCE = {"cmap": colormaps["berlin"], "vmin": -_SPAN, "vmax": _SPAN}
_BARS = {"truth": "x-momentum over the free stream's", "difference": "finer colours"}
_WIDTH, _ROW, _MARGINS = 10.5, 1.66, 0.8  # inches


def draw_strip(judged: Judged) -> Figure:
    """A row a moment: truth, the prediction of a fit that is never updated, their difference."""
    truth, predicted = judged.strip
    shown = SHOWN[: len(truth)]
    columns = (
        ("truth", truth, _FIELD),
        ("predicted, no update", predicted, _FIELD),
        ("difference", predicted - truth, _DIFFERENCE),
    )
    with styled():
        size = (_WIDTH, _ROW * len(shown) + _MARGINS)
        figure = Figure(figsize=size, dpi=DPI, layout="compressed")
        grid = figure.subplots(len(shown), len(columns), squeeze=False)
        for j, (name, fields, colours) in enumerate(columns):
            images = [
                _draw(axes, f, judged, colours) for axes, f in zip(grid[:, j], fields, strict=True)
            ]
            grid[0, j].set_title(name, loc="left", color=TEXT, fontsize=8.5)
            if name in _BARS:
                _bar(figure, images[0], grid[:, j], _BARS[name])
        for axes, k in zip(grid[:, 0], shown, strict=True):
            axes.set_ylabel(_moment(judged, k), rotation=0, ha="right", va="center")
        return figure


def _draw(axes: Axes, field: np.ndarray, judged: Judged, colours: dict[str, Any]) -> AxesImage:
    image = axes.imshow(field, extent=judged.units.window, interpolation="bilinear", **colours)
    axes.add_patch(Circle((0, 0), 0.5, facecolor=PANEL, edgecolor=QUIET, lw=0.4))
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return image


def _bar(figure: Figure, image: AxesImage, column: Any, label: str) -> None:
    bar = figure.colorbar(image, ax=column, location="bottom", aspect=40, pad=0.012, fraction=0.02)
    bar.outline.set_visible(False)
    bar.set_ticks(np.linspace(*image.get_clim(), 5).tolist())
    bar.ax.tick_params(length=0, labelsize=7)
    bar.set_label(label, fontsize=7.5)


def _moment(judged: Judged, frames: int) -> str:
    return f"frame {frames}\n{frames * judged.dt:g} s\n{frames * judged.units.frame_time:.1f} D/U"
