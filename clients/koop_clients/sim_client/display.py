"""Live progress: one line that renews itself on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Sequence
from statistics import median
from typing import TextIO

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.sim_client.scoring import Errors

_TERMINAL_PERIOD, _PLAIN_PERIOD = 0.5, 5.0  # s
_ERASE, _PLAIN = "\r\x1b[K", "\x1b[0m"
_DIM, _BOLD, _GREEN = "\x1b[2m", "\x1b[1m", "\x1b[32m"


class Display:
    """Writes rows under a heading, at most as often as a reader can follow."""

    def __init__(self, out: TextIO | None = None) -> None:
        self._out = out or sys.stderr
        self._terminal = self._out.isatty()
        self._styled = self._terminal and "NO_COLOR" not in os.environ
        self._period = _TERMINAL_PERIOD if self._terminal else _PLAIN_PERIOD
        self._heading = ""
        self._last = -math.inf
        self._open = False

    def say(self, text: str) -> None:
        """A line that stays."""
        self._finish_row()
        print(text, file=self._out, flush=True)

    def due(self, heading: str = "") -> bool:
        """Whether to compose a row now: enough time has passed, or it is the first of a kind."""
        fresh = bool(heading) and heading != self._heading
        return fresh or time.monotonic() - self._last >= self._period

    def row(self, heading: str, text: str) -> None:
        """The present row; it replaces the one before on a terminal."""
        if heading != self._heading:
            self.say("\n" + self._style(_BOLD, heading))
            self._heading = heading
        end = "" if self._terminal else "\n"
        start = _ERASE if self._terminal else ""
        print(start + text, end=end, file=self._out, flush=True)
        self._open = self._terminal
        self._last = time.monotonic()

    def close(self) -> None:
        """Let what follows begin on a line of its own."""
        self._finish_row()

    def dim(self, text: str) -> str:
        """Of less weight, where the terminal can."""
        return self._style(_DIM, text)

    def good(self, text: str) -> str:
        """Green, where the terminal can."""
        return self._style(_GREEN, text)

    def _style(self, code: str, text: str) -> str:
        return f"{code}{text}{_PLAIN}" if self._styled else text

    def _finish_row(self) -> None:
        if self._open:
            print(file=self._out)
        self._open = False


_LEAD = f"{'time':>8} {'frames':>7}  "
_CELL = 11
_NEWEST = 20  # round trips behind a row's


def learning_heading(horizons: tuple[int, ...]) -> str:
    """Heading of the rows while the service learns."""
    cells = "".join(f"{_ahead(h):<{_CELL}}" for h in horizons)
    title = "RMSE per pixel of predictions / of repeating the last frame, after"
    return f"{'':18}{title}\n{_LEAD}{cells}answer"


def learning_row(
    display: Display, number: int, frames: int, errors: Errors | None, standing: str, lag: float
) -> str:
    """A row at frame `number`; `frames` over all plants, `lag` a query's round trip [s]."""
    lead = _lead(number, frames)
    if errors is None or standing:
        return lead + (standing or "waiting for the predicted frames to happen")
    pairs = zip(errors.error, errors.repeat, strict=True)
    cells = [_cell(display, error, repeat) for error, repeat in pairs]
    return lead + "".join(cells) + _milliseconds(lag)


DRIVING_HEADING = f"{_LEAD}{'angle':>9} {'to target':>10} {'torque':>11}   answer"


def driving_row(
    number: int, angle: float, error: float, torque: float, standing: str, lag: float
) -> str:
    """A row while the service drives; angles in rad, torque in N m."""
    state = f"{angle:+5.2f} rad {error:+6.2f} rad {torque:+7.2f} N m"
    return f"{_lead(number, number + 1)}{state}   {standing or _milliseconds(lag)}"


def usual(latencies: Sequence[float]) -> float:
    """Median of the newest round trips [s]; NaN where there is none."""
    newest = list(latencies)[-_NEWEST:]
    return median(newest) if newest else math.nan


def _lead(number: int, frames: int) -> str:
    return f"{number * FRAME_INTERVAL:6.1f} s {frames:7d}  "


def _cell(display: Display, error: float, repeat: float) -> str:
    figures = f"{error:.3f}"
    against = "/" + f"{repeat:.3f}".removeprefix("0")
    padding = " " * (_CELL - len(figures) - len(against))
    return (display.good(figures) if error < repeat else figures) + display.dim(against) + padding


def _ahead(frames: int) -> str:
    seconds = frames * FRAME_INTERVAL
    return f"{seconds:g} s" if seconds >= 1 else f"{round(seconds * 1000)} ms"


def _milliseconds(seconds: float) -> str:
    return "" if math.isnan(seconds) else f"{seconds * 1000:.0f} ms"
