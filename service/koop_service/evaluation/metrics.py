"""The paper's metric: RMSE per pixel at a time step, over all trajectories and pixels in [0, 1]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koop_service.encoding.image_codec import ImageCodec
from koop_service.evaluation.forecasts import Array

PERCENTILES = (10, 50, 90)


@dataclass(frozen=True)
class Score:
    """RMSE at one horizon, and percentiles 10, 50, 90 of the trajectories' own."""

    rmse: float
    p10: float
    p50: float
    p90: float


def squared_errors(pictures: NDArray[np.floating], frames: NDArray[np.uint8]) -> Array:
    """Mean squared error a pixel (...) of pictures (..., H, W) in [0, 1] against uint8 frames."""
    return np.square(pictures - frames * np.float32(1 / 255)).mean((-2, -1), dtype=np.float64)


def decoded_errors(codec: ImageCodec, codes: Array, frames: NDArray[np.uint8]) -> Array:
    """(N, T) squared errors of decoded codes (N, T, n), a trajectory at a time to save memory."""
    return np.stack(
        [squared_errors(codec.decode(z), truth) for z, truth in zip(codes, frames, strict=True)]
    )


def rmse_over_time(errors: Array) -> Array:
    """(T,) root of the mean over trajectories of squared errors (N, T)."""
    return np.sqrt(errors.mean(0))


def spread_over_time(errors: Array) -> Array:
    """(3, T) percentiles over trajectories of each one's RMSE."""
    return np.percentile(np.sqrt(errors), PERCENTILES, axis=0)


def frame_at(horizon: float, fit_frames: int, dt: float) -> int:
    """The frame `horizon` seconds after the last frame of the fit."""
    return fit_frames - 1 + round(horizon / dt)


def score(errors: Array, frame: int) -> Score:
    """The score at one frame of squared errors (N, T)."""
    own = np.sqrt(errors[:, frame])
    return Score(float(np.sqrt(errors[:, frame].mean())), *np.percentile(own, PERCENTILES).tolist())
