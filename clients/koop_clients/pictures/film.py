"""Film strips: frames side by side, with what they show written around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.figure import Figure

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.pictures.theme import LINE, PREDICTION_MAP, QUIET, TRUTH, TRUTH_MAP
from koop_clients.sim_client.scoring import Judged

_GAP = 0.965  # of a cell that is picture
_OUTLINE = 90  # grey level that the truth's outline follows


@dataclass(frozen=True)
class Sheet:
    """A figure measured in inches from its upper left corner."""

    figure: Figure
    width: float
    height: float

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Axes at a place on the sheet [inches]."""
        bottom = self.height - top - height
        return self.figure.add_axes(
            (left / self.width, bottom / self.height, width / self.width, height / self.height)
        )

    def film(
        self, left: float, top: float, width: float, frames: np.ndarray, colours: Colormap
    ) -> list[Axes]:
        """Square cells `width` inches wide in all, one for each of the uint8 frames (T, H, W)."""
        cell = width / len(frames)
        row = []
        for i, frame in enumerate(frames):
            axes = self.axes(left + i * cell, top, cell * _GAP, cell * _GAP)
            axes.imshow(frame, cmap=colours, vmin=0, vmax=255, interpolation="bilinear")
            axes.set(xticks=[], yticks=[])
            axes.grid(visible=False)
            axes.spines[:].set(visible=True, color=LINE, linewidth=0.6)
            row.append(axes)
        return row

    def forecast(
        self, left: float, top: float, width: float, judged: Judged, ahead: Sequence[int]
    ) -> Axes:
        """What happened over what was predicted, at some frames ahead; returns the first axes.

        The outline of what happened is drawn into the prediction too.
        """
        rows = np.asarray(ahead) - 1
        truth = judged.truth[rows]
        upper = self.film(left, top, width, truth, TRUTH_MAP)
        lower_top = top + width / len(ahead)
        lower = self.film(left, lower_top, width, judged.forecast.frames[rows], PREDICTION_MAP)
        for axes, happened, frames in zip(lower, truth, ahead, strict=True):
            axes.contour(happened, [_OUTLINE], colors=TRUTH, linewidths=0.7)
            caption(axes, f"+{seconds(frames)}")
        margin(upper[0], "happened")
        margin(lower[0], "predicted")
        return upper[0]


def caption(axes: Axes, text: str) -> None:
    """A quiet word under a picture."""
    axes.set_xlabel(text, fontsize=7, color=QUIET, labelpad=2)


def margin(axes: Axes, text: str) -> None:
    """A quiet word, upright, left of a picture."""
    axes.set_ylabel(text, fontsize=7, color=QUIET, labelpad=3)


def most_motion(judged: Sequence[Judged]) -> Judged:
    """The forecast over whose span the picture changed most: no easy one is picked."""
    return max(judged, key=lambda j: float(j.repeat[-1]))


def seconds(frames: int) -> str:
    """A number of frames as a time in words."""
    value = frames * FRAME_INTERVAL
    return f"{value:g} s" if value >= 1 else f"{round(1000 * value)} ms"
