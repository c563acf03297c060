"""Pictures of control: every start's way to the target, plans against what came of them, a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from koop_service.evaluation.control.methods import METHODS
from koop_service.evaluation.control.plants import Plant
from koop_service.evaluation.control.study import Change, OpenLoop
from koop_service.evaluation.control.trials import Array, Trials
from koop_service.evaluation.strips import mosaic
from koop_service.evaluation.theme import DPI, GREYS, PANEL, QUIET, TEXT, styled

COLOURS = {
    "mpc": "#4fd18b",
    "gain": "#5fd4d6",
    "frozen": "#5aa9ff",
    "learned-B": "#f5b83d",
    "pd": "#93a0ad",
    "state-lqr": "#e8edf2",
}
_SUCCESS = 0.1  # rad


def draw_ways(trials: Mapping[str, Trials], dt: float) -> Figure:
    """Each start's angle from the target over time, a panel a method."""
    with styled():
        rows = -(-len(trials) // 3)
        figure = Figure(figsize=(11.0, 0.5 + 2.3 * rows), dpi=DPI, layout="constrained")
        axes = np.atleast_1d(figure.subplots(rows, 3, sharex=True, sharey=True)).ravel()
        for panel, (name, found) in zip(axes, trials.items(), strict=False):
            _ways(panel, name, found, dt)
        for panel in axes[len(trials) :]:
            panel.set_visible(False)
        figure.supylabel("angle from the target [rad]", color=QUIET, fontsize=8.5)
        figure.supxlabel("time since takeover [s]", color=QUIET, fontsize=8.5)
        return figure


def _ways(axes: Axes, name: str, found: Trials, dt: float) -> None:
    times = np.arange(found.angles.shape[1]) * dt
    axes.axhspan(-_SUCCESS, _SUCCESS, color=QUIET, alpha=0.18, lw=0)
    axes.plot(times, _without_jumps(found.angles).T, color=COLOURS[name], lw=0.6, alpha=0.45)
    axes.set_ylim(-1.6, 1.6)
    axes.set_xlim(0, times[-1])
    axes.set_title(
        f"{METHODS[name].title}: {found.success.sum()} of {len(found.success)}",
        loc="left",
        color=TEXT,
        fontsize=8.5,
    )


def _without_jumps(angles: Array) -> Array:
    """Angles (N, T) without the lines from -pi to pi of a pole that turns over."""
    jumps = np.abs(np.diff(angles, append=angles[:, -1:])) > np.pi
    return np.where(jumps, np.nan, angles)


def draw_change(changes: Sequence[Change], dt: float) -> Figure:
    """Distance from the target around a change of mass, online against frozen."""
    with styled():
        figure = Figure(figsize=(5.6 * len(changes), 3.3), dpi=DPI, layout="constrained")
        panels = np.atleast_1d(figure.subplots(1, len(changes))).tolist()
        for axes, change in zip(panels, changes, strict=True):
            for name, method in (("frozen", "frozen"), ("online", "mpc")):
                _distance(axes, change.runs[name], COLOURS[method], f"{name} model", dt)
            axes.axvline(change.at, color=QUIET, lw=0.9, ls=(0, (4, 3)))
            axes.set_title(change.title, loc="left", color=TEXT, fontsize=8.5)
            axes.set_xlabel("time since takeover [s]")
            axes.legend(frameon=False, labelcolor=TEXT, fontsize=7.5)
        panels[0].set_ylabel("distance from the target [rad]")
        return figure


def _distance(axes: Axes, found: Trials, colour: str, label: str, dt: float) -> None:
    times = np.arange(found.angles.shape[1]) * dt
    low, middle, high = np.nanquantile(np.abs(found.angles), (0.25, 0.5, 0.75), axis=0)
    axes.fill_between(times, low, high, color=colour, alpha=0.15, lw=0)
    axes.plot(times, middle, color=colour, label=label)
    axes.set(xlim=(0, times[-1]), ylim=(0, None))


def draw_plan(plant: Plant, found: OpenLoop, dt: float) -> Figure:
    """Figures 6 and 13: the plan's decoded pictures above what the plant did, angle and torque."""
    with styled():
        steps = len(found.planned)
        figure = Figure(figsize=(11.0, 5.0), dpi=DPI, layout="constrained")
        film, curves = np.array(figure.subfigures(2, 1, height_ratios=(2.1, 2.2))).tolist()
        axes = film.subplots()
        pictures = np.stack([found.planned, found.achieved])
        axes.imshow(mosaic(pictures), cmap=GREYS, vmin=0, vmax=255, aspect="equal")
        axes.set_axis_off()
        axes.set_title(
            f"{plant.system.title}, open loop over {steps * dt:g} s: planned (above), achieved",
            loc="left",
            color=TEXT,
            fontsize=8.5,
        )
        angle, torque = curves.subplots(1, 2)
        times = np.arange(len(found.angles)) * dt
        angle.plot(times, found.angles, color=COLOURS["mpc"])
        angle.axhline(0, color=QUIET, lw=0.9, ls=(0, (4, 3)))
        angle.set(ylabel="angle from the target [rad]", xlabel="time [s]")
        torque.step(times[: len(found.torques)], found.torques, where="post", color=COLOURS["mpc"])
        torque.set(ylabel="torque [N m]", xlabel="time [s]")
        return figure


def save_film(found: Trials, dt: float, path: Path) -> None:
    """The first plant's closed loop as an animated picture: what the camera saw, and the torque."""
    with styled():
        figure = Figure(figsize=(5.2, 2.6), dpi=100)
        camera = figure.add_axes((0.01, 0.02, 0.48, 0.96))
        shown = camera.imshow(found.frames[0], cmap=GREYS, vmin=0, vmax=255)
        camera.set(xticks=[], yticks=[], facecolor=PANEL)
        camera.grid(visible=False)
        times = np.arange(found.angles.shape[1]) * dt
        axes = [figure.add_axes((0.6, bottom, 0.38, 0.33)) for bottom in (0.6, 0.13)]
        for panel, values, label in (
            (axes[0], found.angles[0], "angle [rad]"),
            (axes[1], found.torques[0], "torque [N m]"),
        ):
            panel.plot(times, values, color="#2b333d")
            panel.set_title(label, loc="left", fontsize=7.5, color=QUIET)
        lines = [panel.plot([], [], color=COLOURS["mpc"])[0] for panel in axes]

        def draw(k: int) -> list[Artist]:
            shown.set_data(found.frames[k])
            for line, values in zip(lines, (found.angles[0], found.torques[0]), strict=True):
                line.set_data(times[: k + 1], values[: k + 1])
            return [shown, *lines]

        count = min(len(found.frames), round(4 / dt))
        film = FuncAnimation(figure, draw, frames=count, interval=1000 * dt)
        film.save(path, writer=PillowWriter(fps=round(1 / dt)))
