"""What a run keeps for pictures: its first and last predictions, and the drive."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koop_clients.sim_client.scoring import Forecast, Judged, judge

_FIRST, _LAST = 20, 50  # forecasts
_LONGEST_DRIVE = 2400  # frames


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


class DriveLog:
    """Frame, angle [rad] and torque [N m] at each frame of a drive, in bounded memory."""

    def __init__(self) -> None:
        self.frames: deque[np.ndarray] = deque(maxlen=_LONGEST_DRIVE)
        self.angles: deque[float] = deque(maxlen=_LONGEST_DRIVE)
        self.torques: deque[float] = deque(maxlen=_LONGEST_DRIVE)

    def add(self, frame: np.ndarray, angle: float, torque: float) -> None:
        """A frame, and the torque that acts after it."""
        self.frames.append(frame)
        self.angles.append(angle)
        self.torques.append(torque)


@dataclass(frozen=True, eq=False)
class Record:
    """A run as `--record` saves it.

    Attributes:
        system: name of the plant.
        early: some of the first forecasts, judged.
        late: some of the last ones.
        drive_frames: (T, 64, 64) uint8, empty without a drive.
        drive_angles: (T,) [rad].
        drive_torques: (T,) [N m].
        target: angle to reach [rad].
        torque_bound: [N m].
    """

    system: str
    early: list[Judged]
    late: list[Judged]
    drive_frames: np.ndarray
    drive_angles: np.ndarray
    drive_torques: np.ndarray
    target: float
    torque_bound: float

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
                drive_angles=self.drive_angles,
                drive_torques=self.drive_torques,
                target=self.target,
                torque_bound=self.torque_bound,
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
                file["drive_angles"],
                file["drive_torques"],
                float(file["target"]),
                float(file["torque_bound"]),
            )


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
