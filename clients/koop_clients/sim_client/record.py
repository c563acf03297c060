"""What a run keeps for pictures: its first and last predictions, and the drives."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from koop_clients.sim_client.scoring import Forecast, Judged, judge

_FIRST, _LAST = 20, 50  # forecasts


class Scorebook:
    """The first and the last judged forecasts of a run, in bounded memory."""

    def __init__(self) -> None:
        self.first: list[Judged] = []
        self.last: deque[Judged] = deque(maxlen=_LAST)

    def add(self, judged: Judged) -> None:
        """The next forecast, in order of time."""
        if len(self.first) < _FIRST:
            self.first.append(judged)
        else:
            self.last.append(judged)

    def recent(self, count: int = _FIRST + _LAST) -> list[Judged]:
        """The newest `count` of those kept."""
        return [*self.first, *self.last][-count:]


@dataclass(frozen=True, eq=False)
class Record:
    """A run as `--record` saves it.

    Attributes:
        system: name of the plant.
        early: some of the first forecasts, judged.
        late: some of the last ones.
        drive_frames: (T, 64, 64) uint8, of the first plant; empty without a drive.
        drives: (plants, T, 3): angle [rad], rate [rad/s] and torque [N m] at each frame of each
            plant's drive; NaN where one was shorter than the longest.
        target: angle to reach [rad].
        torque_bound: [N m].
        planned: (N, 64, 64) uint8, what the first plant's blind plan was to lead to, frame by
            frame after the first of `drive_frames`; empty without one.
    """

    system: str
    early: list[Judged]
    late: list[Judged]
    drive_frames: np.ndarray
    drives: np.ndarray
    target: float
    torque_bound: float
    planned: np.ndarray = field(default_factory=lambda: np.zeros((0, 64, 64), np.uint8))

    @property
    def drive_angles(self) -> np.ndarray:
        """(T,) of the first plant [rad]."""
        return self._first_drive()[:, 0]

    @property
    def drive_torques(self) -> np.ndarray:
        """(T,) of the first plant [N m]."""
        return self._first_drive()[:, 2]

    def _first_drive(self) -> np.ndarray:
        """(T, 3), T frames as in `drive_frames`."""
        return self.drives[0, : len(self.drive_frames)] if len(self.drives) else np.zeros((0, 3))

    @property
    def ahead(self) -> int:
        """Frames that the forecasts look ahead; 0 where there is none."""
        return len(self.early[0].truth) if self.early else 0

    def save(self, path: Path) -> None:
        """Write it as one compressed .npz file."""
        arrays: dict[str, Any] = {
            **_forecast_arrays("early", self.early),
            **_forecast_arrays("late", self.late),
        }
        with path.open("wb") as file:
            np.savez_compressed(
                file,
                system=self.system,
                drive_frames=self.drive_frames,
                drives=self.drives,
                target=self.target,
                torque_bound=self.torque_bound,
                planned=self.planned,
                **arrays,
            )

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read what `save` wrote."""
        with np.load(path) as file:
            return cls(
                str(file["system"]),
                _forecasts("early", file),
                _forecasts("late", file),
                file["drive_frames"],
                file["drives"],
                float(file["target"]),
                float(file["torque_bound"]),
                file["planned"],
            )


def stack_series(series: Sequence[np.ndarray], columns: int = 3) -> np.ndarray:
    """Arrays (T_i, columns) as one (N, T, columns), the shorter ones filled up with NaN."""
    longest = max((len(rows) for rows in series), default=0)
    stacked = np.full((len(series), longest, columns), np.nan)
    for row, values in zip(stacked, series, strict=True):
        row[: len(values)] = values
    return stacked


def _forecast_arrays(name: str, judged: list[Judged]) -> dict[str, np.ndarray]:
    return {
        f"{name}_seq": np.array([j.forecast.seq for j in judged], np.int64),
        f"{name}_last": np.array([j.forecast.last for j in judged], np.uint8),
        f"{name}_predicted": np.array([j.forecast.frames for j in judged], np.uint8),
        f"{name}_truth": np.array([j.truth for j in judged], np.uint8),
    }


def _forecasts(name: str, file: np.lib.npyio.NpzFile) -> list[Judged]:
    parts = (file[f"{name}_{part}"] for part in ("seq", "last", "predicted", "truth"))
    return [
        judge(Forecast(int(seq), last, predicted), truth)
        for seq, last, predicted, truth in zip(*parts, strict=True)
    ]
