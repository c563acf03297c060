"""How far predictions are from what happened. Pure bookkeeping over frames and their numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Forecast:
    """A prediction, and what "repeat the last frame" would have said instead.

    Attributes:
        seq: number of the last frame that the prediction knows.
        last: that frame, (H, W) uint8 or (C, H, W).
        frames: predicted frames, (ahead, ...); row i is frame seq + 1 + i.
    """

    seq: int
    last: np.ndarray
    frames: np.ndarray


@dataclass(frozen=True, eq=False)
class Judged:
    """A forecast whose truth has come.

    Attributes:
        forecast: the prediction.
        truth: what happened, shaped like the forecast's frames.
        error: RMSE per pixel of each predicted frame, pixels in [0, 1], (ahead,).
        repeat: the same for repeating the last frame, (ahead,).
    """

    forecast: Forecast
    truth: np.ndarray
    error: np.ndarray
    repeat: np.ndarray


class Judge:
    """Holds the forecasts of one trajectory until the frames that they speak of have come."""

    def __init__(self) -> None:
        self._open: list[tuple[Forecast, list[np.ndarray]]] = []

    def predict(self, forecast: Forecast) -> None:
        """A forecast made before frame seq + 1 was seen."""
        self._open.append((forecast, []))

    def see(self, seq: int, frame: np.ndarray) -> list[Judged]:
        """Frame `seq` as it happened; the forecasts that it completes. Frames come in order."""
        for forecast, truth in self._open:
            if seq == forecast.seq + 1 + len(truth):
                truth.append(frame)
        done = [(f, t) for f, t in self._open if len(t) == len(f.frames)]
        self._open = [(f, t) for f, t in self._open if len(t) < len(f.frames)]
        return [judge(forecast, np.stack(truth)) for forecast, truth in done]

    def forget(self) -> None:
        """Drop the open forecasts: their controls will not be the ones that act."""
        self._open.clear()


def judge(forecast: Forecast, truth: np.ndarray) -> Judged:
    """Compare a forecast with what happened."""
    return Judged(forecast, truth, rmse(forecast.frames, truth), rmse(forecast.last[None], truth))


def rmse(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Root mean square difference of each frame (T, ...): (T,).

    Of uint8 pictures in units of full white, of fields in their own.
    """
    scale = 255.0 if right.dtype == np.uint8 else 1.0
    difference = (left.astype(np.float64) - right.astype(np.float64)) / scale
    return np.sqrt(np.mean(difference**2, axis=tuple(range(1, difference.ndim))))


@dataclass(frozen=True)
class Errors:
    """RMSE per pixel at some horizons over several forecasts, pixels in [0, 1].

    Attributes:
        horizons: frames ahead.
        error: of the predictions, by horizon.
        repeat: of repeating the last frame, by horizon.
        count: forecasts.
    """

    horizons: tuple[int, ...]
    error: tuple[float, ...]
    repeat: tuple[float, ...]
    count: int

    @property
    def beats_repeating(self) -> bool:
        """Whether the predictions are better at every horizon."""
        return all(e < r for e, r in zip(self.error, self.repeat, strict=True))


def pool(judged: Iterable[Judged], horizons: Sequence[int]) -> Errors | None:
    """Root mean square over all forecasts at each horizon; None where there is no forecast."""
    forecasts = list(judged)
    if not forecasts:
        return None
    rows = np.asarray(horizons) - 1
    error = np.sqrt(np.mean([j.error[rows] ** 2 for j in forecasts], axis=0))
    repeat = np.sqrt(np.mean([j.repeat[rows] ** 2 for j in forecasts], axis=0))
    return Errors(tuple(horizons), tuple(error.tolist()), tuple(repeat.tolist()), len(forecasts))
