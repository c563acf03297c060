"""Pictures of a wake that is calmed: figure 16, how fast by which method, and a film."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle

from koop_service.evaluation.fluid.control.methods import METHODS
from koop_service.evaluation.fluid.control.trials import CALM, INTERVAL, PROMPT, Trials
from koop_service.evaluation.fluid.errors import COLOURS
from koop_service.evaluation.theme import DPI, PANEL, QUIET, TEXT, styled

SHOWN = (0, 4, 8, 12, 16, 24, 32, 48, 64, 128, 256)
"""Frames of the drive that figure 16 shows."""
WINDOW = (-2.0, 10.0, -3.0, 3.0)
"""x from, to, y from, to [D]."""

_FIELD: Any = {"cmap": colormaps["magma_r"], "vmin": COLOURS[0], "vmax": COLOURS[1]}
_FILMED = 100  # frames
_LEAST = 1e-5  # of the natural swing; nothing smaller is of interest


def draw_strip(found: Trials) -> Figure:
    """Figure 16: x-momentum on the way to the steady flow, and that flow at last."""
    shown = [k for k in SHOWN if k < len(found.momenta)]
    pictures = [(f"frame {k}, {k * INTERVAL:g} s", found.momenta[k]) for k in shown]
    pictures.append(("the target, steady flow", found.target))
    with styled():
        rows = -(-len(pictures) // 3)
        figure = Figure(figsize=(10.5, 0.3 + 1.93 * rows), dpi=DPI, layout="compressed")
        grid = figure.subplots(rows, 3).ravel()
        for axes, (name, field) in zip(grid, pictures, strict=False):
            _draw(axes, field)
            axes.set_title(name, loc="left", color=TEXT, fontsize=8.5)
        for axes in grid[len(pictures) :]:
            axes.set_visible(False)
        return figure


def _draw(axes: Axes, field: np.ndarray) -> AxesImage:
    image = axes.imshow(field, extent=WINDOW, interpolation="bilinear", **_FIELD)
    axes.add_patch(Circle((0, 0), 0.5, facecolor=PANEL, edgecolor=QUIET, lw=0.4))
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return image


def draw_swings(trials: Mapping[str, Trials]) -> Figure:
    """The wake's swing over the natural one, and the rotation, by frame; a line a wake."""
    with styled():
        figure = Figure(figsize=(10.5, 5.6), dpi=DPI, layout="constrained")
        swing, rotation = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for name, found in trials.items():
            _lines(swing, np.maximum(found.swings(), _LEAST), name)
            _lines(rotation, np.abs(found.rotations), name)
        swing.axhline(CALM, color=QUIET, lw=0.9, ls=(0, (4, 3)))
        swing.axvline(PROMPT, color=QUIET, lw=0.9, ls=(0, (4, 3)))
        swing.set(yscale="log", ylabel="swing over the natural one")
        rotation.set(
            yscale="log",
            ylim=(1e-4, 1),
            ylabel="|rotation| [U/D]",
            xlabel="frames since takeover",
            xlim=(0, next(iter(trials.values())).probes.shape[1] - 1),
        )
        swing.legend(frameon=False, labelcolor=TEXT, fontsize=7.5, loc="upper right", ncols=2)
        return figure


def _lines(axes: Axes, values: np.ndarray, name: str) -> None:
    method = METHODS[name]
    lines = axes.plot(values.T, color=method.colour, lw=0.9, alpha=0.75)
    lines[0].set_label(method.title)


def save_film(found: Trials, path: Path) -> None:
    """The first wake as it is calmed, with the velocity behind the cylinder and the rotation."""
    with styled():
        figure = Figure(figsize=(6.4, 3.0), dpi=100)
        flow = figure.add_axes((0.01, 0.12, 0.6, 0.8))
        image = _draw(flow, found.momenta[0])
        count = min(_FILMED, len(found.momenta))
        panels = (
            ("v behind the cylinder [U]", found.probes[0, :count]),
            ("rotation [U/D]", found.rotations[0, :count]),
        )
        lines = []
        for bottom, (label, values) in zip((0.6, 0.12), panels, strict=True):
            axes = figure.add_axes((0.7, bottom, 0.28, 0.3))
            axes.plot(values, color="#2b333d")
            axes.set_title(label, loc="left", fontsize=7.5, color=QUIET)
            lines.append((axes.plot([], [], color=METHODS["mpc"].colour)[0], values))

        def draw(k: int) -> list[Artist]:
            image.set_data(found.momenta[k])
            for line, values in lines:
                line.set_data(np.arange(k + 1), values[: k + 1])
            return [image, *(line for line, _ in lines)]

        film = FuncAnimation(figure, draw, frames=count, interval=1000 * INTERVAL)
        film.save(path, writer=PillowWriter(fps=10))
