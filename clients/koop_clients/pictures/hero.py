"""The demo's picture: it learns, it predicts, it drives."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from koop_clients.mechanics.simulation import FRAME_INTERVAL, angle_between
from koop_clients.pictures.film import Sheet, caption, most_motion
from koop_clients.pictures.theme import (
    DPI,
    EARLY,
    PREDICTION,
    QUIET,
    STYLE,
    TEXT,
    TRUTH,
    TRUTH_MAP,
    title,
)
from koop_clients.sim_client.driving.outcome import NEAR
from koop_clients.sim_client.record import Record
from koop_clients.sim_client.scoring import Errors, Judged, pool

_WIDTH, _HEIGHT = 10.0, 6.4  # inches
_LEFT, _HALF, _FULL = 0.28, 4.72, 9.68
_AHEAD = (1, 4, 8, 14, 20)  # frames
_FIRST = 5  # forecasts that count as early in the film
_SHOWN = 3.0  # s of the drive
_DRIVE_FRAMES = 11


def draw_hero(record: Record, path: Path) -> None:
    """Save the picture of a run; raises ValueError without forecasts early and late and a drive."""
    ahead = range(1, record.ahead + 1)
    early, late = pool(record.early, ahead), pool(record.late, ahead)
    if early is None or late is None or not len(record.drive_frames):
        raise ValueError("the picture needs early and late predictions and a drive")
    with mpl.rc_context(STYLE):
        sheet = Sheet(Figure(figsize=(_WIDTH, _HEIGHT), dpi=DPI), _WIDTH, _HEIGHT)
        _forecasts(sheet, record)
        _drive_film(sheet, record)
        _error_plot(sheet.axes(0.52, 4.45, 4.2, 1.5), early, late)
        _angle_plot(sheet.axes(5.45, 4.45, 4.46, 0.85), record)
        _torque_plot(sheet.axes(5.45, 5.4, 4.46, 0.55), record)
        sheet.figure.savefig(path)


def _forecasts(sheet: Sheet, record: Record) -> None:
    early, late = most_motion(record.early[:_FIRST]), most_motion(record.late)
    ahead = [h for h in _AHEAD if h <= record.ahead]
    left = sheet.forecast(_LEFT, 0.42, _HALF, early, ahead)
    title(left, _after(early), "its predictions, on first acquaintance")
    right = sheet.forecast(_LEFT + _FULL - _HALF + 0.02, 0.42, _HALF, late, ahead)
    title(right, _after(late), "with the learned dynamics (outlined: what happened)")


def _after(judged: Judged) -> str:
    return f"after {(judged.forecast.seq + 1) * FRAME_INTERVAL:.1f} s"


def _drive_film(sheet: Sheet, record: Record) -> None:
    last = min(len(record.drive_frames) - 1, round(_SHOWN / FRAME_INTERVAL))
    # More of the beginning, where the pole moves.
    shown = np.round(np.linspace(0, 1, _DRIVE_FRAMES) ** 1.7 * last).astype(int)
    row = sheet.film(_LEFT, 2.93, _FULL, record.drive_frames[shown], TRUTH_MAP)
    for axes, number in zip(row, shown, strict=True):
        caption(axes, f"{number * FRAME_INTERVAL:.2f} s")
    title(row[0], "then it drives", "by the commands of koop/command, to a picture of the target")


def _error_plot(axes: Axes, early: Errors, late: Errors) -> None:
    times = np.array(early.horizons) * FRAME_INTERVAL
    curves = (
        (late.repeat, "repeating the last frame", QUIET, (0, (1, 1.5))),
        (early.error, "first predictions", EARLY, "-"),
        (late.error, "last predictions", PREDICTION, "-"),
    )
    for values, name, colour, dashes in curves:
        axes.plot(times, values, color=colour, linestyle=dashes, label=name)
    axes.set(xlim=(0, times[-1]), ylim=(0, None), xlabel="seconds ahead")
    axes.legend(frameon=False, fontsize=7, labelcolor="linecolor", handlelength=1.6)
    title(axes, "prediction error", "RMSE per pixel, from 0 (black) to 1 (white)")


def _angle_plot(axes: Axes, record: Record) -> None:
    errors = angle_between(record.drive_angles, record.target)
    times = np.arange(len(errors)) * FRAME_INTERVAL
    axes.axhspan(-NEAR, NEAR, color=TRUTH, alpha=0.15, linewidth=0)
    axes.plot(times, errors, color=TEXT)
    axes.set(xlim=(0, times[-1]), ylabel="angle [rad]")
    axes.tick_params(labelbottom=False)
    title(axes, "the pole's way to its target", "as the simulator knows it (band: 0.1 rad)")


def _torque_plot(axes: Axes, record: Record) -> None:
    times = np.arange(len(record.drive_torques)) * FRAME_INTERVAL
    bound = record.torque_bound
    for level in (-bound, bound):
        axes.axhline(level, color=QUIET, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.step(times, record.drive_torques, where="post", color=PREDICTION, linewidth=1.2)
    axes.set(
        xlim=(0, times[-1]),
        ylim=(-1.3 * bound, 1.3 * bound),
        yticks=[-bound, 0, bound],
        xlabel="seconds since it took over",
        ylabel="torque [N m]",
    )
