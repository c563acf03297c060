"""Test sequences: stretches of one long recorded flow, which stay views of it to save memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from koop_protocol import recording as names
from koop_service.evaluation.datasets import TestSet
from koop_service.evaluation.forecasts import Array
from koop_service.learning.recording import load_manifest, load_recording

X_MOMENTUM = "rho u"


@dataclass(frozen=True)
class Units:
    """What a frame shows: its channels' names, x-momentum's normalisation, and the window [D].

    `free_stream` is the x-momentum far away, `frame_time` the time between two frames [D/U].
    """

    channels: tuple[str, ...]
    mean: float
    scale: float
    free_stream: float
    window: tuple[float, float, float, float]
    frame_time: float

    @property
    def shown(self) -> int:
        """The channel of the x-momentum."""
        return self.channels.index(X_MOMENTUM)

    def x_momentum(self, frames: np.ndarray) -> np.ndarray:
        """x-momentum (..., H, W) [free streams] of frames (..., C, H, W), float32."""
        field = frames[..., self.shown, :, :].astype(np.float32)
        return (field * self.scale + self.mean) / self.free_stream


@dataclass(frozen=True, eq=False)
class Sequences:
    """N sequences of T frames that begin at `starts` of one trajectory."""

    test: TestSet
    starts: Sequence[int]
    length: int
    units: Units

    @property
    def frames(self) -> np.ndarray:
        """(L, C, H, W), the whole trajectory."""
        return self.test.recording.frames[0]

    @property
    def controls(self) -> Array:
        """(N, T-1, p)."""
        return self.cut(self.test.recording.controls[0], self.length - 1)

    def of(self, i: int) -> np.ndarray:
        """Frames (T, C, H, W) of sequence i, a view."""
        return self.frames[self.starts[i] : self.starts[i] + self.length]

    def cut(self, values: Array, length: int | None = None) -> Array:
        """(N, T, ...) of values (L, ...) along the trajectory."""
        length = length or self.length
        return np.stack([values[start : start + length] for start in self.starts])

    @property
    def period(self) -> float | None:
        """Frames of a shedding period, between upward crossings of the probe's velocity."""
        return crossing_period(self.test.states[0, :, 0])


def crossing_period(velocity: Array) -> float | None:
    """Mean distance [frames] of the upward crossings of zero; None where there are under two."""
    before, after = velocity[:-1], velocity[1:]
    (at,) = np.nonzero((before < 0) & (after >= 0))
    if len(at) < 2:
        return None
    moments = at - before[at] / (after[at] - before[at])
    return float((moments[-1] - moments[0]) / (len(moments) - 1))


def load_sequences(path: Path, starts: Sequence[int], length: int) -> Sequences:
    """Read a test set of one trajectory. Raises ValueError where it does not say what it shows."""
    recording = load_recording(path)
    with h5py.File(path, "r") as file:
        states: Any = file[names.STATES_DATASET]
        units = _units(path, file.attrs, recording.frames[0, 0])
        return Sequences(TestSet(recording, states[:]), starts, length, units)


def _units(path: Path, attributes: Any, frame: np.ndarray) -> Units:
    try:
        channels = tuple(str(name) for name in attributes[names.CHANNELS_ATTRIBUTE])
        which = channels.index(X_MOMENTUM)
        mean = float(attributes[names.CHANNEL_MEAN_ATTRIBUTE][which])
        scale = float(attributes[names.CHANNEL_SCALE_ATTRIBUTE][which])
        left, right, low, high = (float(x) for x in attributes[names.WINDOW_ATTRIBUTE])
        frame_time = float(load_manifest(path)[0]["frame_time"])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} does not say what its fields show ({error}); delete it, and koop-dataset "
            "makes it anew"
        ) from error
    # The pixels of the cylinder, which stands at (0, 0), carry the free stream.
    height, width = frame.shape[1:]
    row, column = int(height * high / (high - low)), int(width * -left / (right - left))
    free_stream = float(frame[which, row, column]) * scale + mean
    return Units(channels, mean, scale, free_stream, (left, right, low, high), frame_time)
