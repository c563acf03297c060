"""Predicted codes of many trajectories at once, whatever the model and however it is updated.

One path for every method, so that only the idea differs: a schedule says after which frames the
roll-out restarts from measured codes, a source of models gives Theta there (eq. 8).
Shapes: N trajectories, T frames, codes (N, T, n), controls (N, T-1, p) with control k acting
between frames k and k+1, Theta (N, n, d) over w_t = [z_{t-h+1}; ...; z_t; u_t; 1?], oldest first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from koop_service.estimation.settings import EstimatorSettings
from koop_service.learning.streaming import regressor

Array = NDArray[np.float64]

SATURATION = 1e6
"""A diverging roll-out stops here, far beyond any code, so that its pictures are still numbers."""


class Models(Protocol):
    """Where a method's Theta comes from."""

    settings: EstimatorSettings

    def thetas(self, codes: Array, controls: Array, lasts: Sequence[int]) -> Iterator[Array]:
        """Theta (N, n, d) known after each of the frames `lasts`, which rise."""
        ...


@dataclass(frozen=True)
class Schedule:
    """Theta from the first `fit_frames` frames, then anew every `every` frames (None: never)."""

    fit_frames: int
    every: int | None = None

    def restarts(self, frames: int) -> range:
        """The last known frame of each roll-out of a trajectory of `frames` frames."""
        return range(self.fit_frames - 1, frames - 1, self.every or frames)


def forecast(models: Models, schedule: Schedule, codes: Array, controls: Array) -> Array:
    """Codes (N, T, n): measured in the fit frames, predicted after them.

    Raises ValueError where the fit frames are fewer than the history needs, or are all there are.
    """
    frames, h = codes.shape[1], models.settings.history
    if not h < schedule.fit_frames < frames:
        raise ValueError(
            f"a fit on {schedule.fit_frames} of {frames} frames; expected more than the "
            f"history's {h}, and fewer than there are"
        )
    starts = schedule.restarts(frames)
    predicted = codes.copy()
    for start, Theta in zip(starts, models.thetas(codes, controls, starts), strict=True):
        stop = min(start + starts.step, frames - 1)
        history = codes[:, start - h + 1 : start + 1]
        ahead = roll_out(Theta, history, controls[:, start:stop], models.settings)
        predicted[:, start + 1 : stop + 1] = ahead
    return predicted


def roll_out(Theta: Array, history: Array, controls: Array, settings: EstimatorSettings) -> Array:
    """Codes (N, K, n) after `history` (N, h, n) under `controls` (N, K, p)."""
    h, K = history.shape[1], controls.shape[1]
    codes = np.concatenate([history, np.zeros((len(history), K, history.shape[2]))], axis=1)
    for t in range(h, h + K):
        w = regressor(codes[:, t - h : t], controls[:, t - h], settings)
        codes[:, t] = np.clip(np.einsum("knd,kd->kn", Theta, w), -SATURATION, SATURATION)
    return codes[:, h:]


def transitions(
    codes: Array, controls: Array, first: int, last: int, settings: EstimatorSettings
) -> Iterator[tuple[Array, Array]]:
    """(W (N, d), Y (N, n)) of each target frame first ... last, as they would be measured."""
    h = settings.history
    for t in range(max(first, h), last + 1):
        yield regressor(codes[:, t - h : t], controls[:, t - 1], settings), codes[:, t]


def stacked(
    codes: Array, controls: Array, settings: EstimatorSettings
) -> Iterator[tuple[Array, Array]]:
    """W (K, d) and Y (K, n), all the transitions of each trajectory."""
    pairs = list(transitions(codes, controls, 1, codes.shape[1] - 1, settings))
    W, Y = (np.stack(part, axis=1) for part in zip(*pairs, strict=True))
    return zip(W, Y, strict=True)
