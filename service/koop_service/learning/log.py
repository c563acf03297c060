"""The log of a training: one CSV row every `EVERY` steps, also across a kill and resume."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from koop_service.learning.objective import Loss
from koop_service.learning.train import STAGES, Setting, Training

EVERY = 50  # steps
COLUMNS = (
    "stage",
    "step",
    "frames",
    "seconds",
    "horizon",
    "reconstruction",
    "prediction",
    "codes",
    "rate",
)


class Log:
    """Figures averaged over the steps since the last row; `rate` in frames a second."""

    def __init__(self, path: Path, setting: Setting, resumed: Training) -> None:
        self._path, self._setting = path, setting
        self._losses: list[tuple[float, float, float]] = []
        self._last = resumed.frames, resumed.seconds
        rows = _rows_until(path, resumed)
        partial = path.with_name(path.name + ".partial")
        with partial.open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *rows])
        partial.replace(path)

    def __call__(self, training: Training, loss: Loss) -> None:
        """Take one more step's figures, and write a row if it is time."""
        self._losses.append((loss.reconstruction, loss.prediction, loss.codes))
        if training.step % EVERY and training.step < self._setting.stage(training.stage).steps:
            return
        frames, seconds = self._last
        spent = max(training.seconds - seconds, 1e-9)
        row = [
            training.stage_name,
            training.step,
            training.frames,
            f"{training.seconds:.1f}",
            loss.horizon,
            *(f"{value:.6g}" for value in np.array(self._losses).mean(0)),
            f"{(training.frames - frames) / spent:.1f}",
        ]
        with self._path.open("a", newline="") as file:
            csv.writer(file).writerow(row)
        self._losses, self._last = [], (training.frames, training.seconds)


def _rows_until(path: Path, resumed: Training) -> list[list[str]]:
    """The rows that a killed run wrote before the checkpoint that is resumed."""
    if not path.exists() or not (resumed.step or resumed.stage):
        return []
    with path.open(newline="") as file:
        rows = [row for row in csv.reader(file) if len(row) == len(COLUMNS)][1:]
    done = (resumed.stage, resumed.step)
    return [row for row in rows if (STAGES.index(row[0]), int(row[1])) <= done]
