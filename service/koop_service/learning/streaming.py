"""What the service would know along a recorded trajectory, as it streams in frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koop_service.estimation import factor
from koop_service.estimation.innovation import InnovationStatistics
from koop_service.estimation.proximal import solve
from koop_service.estimation.settings import EstimatorSettings
from koop_service.prediction.model import LinearModel

Array = NDArray[np.float64]

STRIDE = 10  # frames between two moments that are judged


@dataclass(frozen=True, eq=False)
class Encoded:
    """One trajectory: `images` (T, ...) float32, `codes` (T, n), `controls` (T-1, p)."""

    images: np.ndarray
    codes: np.ndarray
    controls: np.ndarray


@dataclass(frozen=True, eq=False)
class Moment:
    """All that a prediction from frame `t` on is made of, and what then came.

    model, history (h, n), S (n, n) and R (d, d): see `prediction.uncertainty`; controls (K, p) and
    future (K, n), the codes that followed.
    """

    t: int
    model: LinearModel
    history: np.ndarray
    S: np.ndarray
    R: np.ndarray
    controls: np.ndarray
    future: np.ndarray


def moments(trajectory: Encoded, settings: EstimatorSettings, ahead: int) -> Iterator[Moment]:
    """Every `STRIDE`-th frame after warm-up that has `ahead` more behind it."""
    codes, controls = trajectory.codes, trajectory.controls
    state, statistics = factor.init(settings), InnovationStatistics(settings, 1)
    h, lane = settings.history, np.zeros(1, np.int64)
    for t in range(h - 1, len(codes) - 1):
        if t >= settings.warmup_frames and t % STRIDE == 0 and t + ahead < len(codes):
            rho, iterations = settings.rho, settings.solve_iterations
            theta = solve(state.R, state.D, rho, iterations, settings.centre)
            yield Moment(
                t,
                LinearModel.from_theta(theta, settings),
                codes[t - h + 1 : t + 1],
                statistics.covariance(0),
                state.R.copy(),
                controls[t : t + ahead],
                codes[t + 1 : t + 1 + ahead],
            )
        w = regressor(codes[t - h + 1 : t + 1], controls[t], settings)
        innovation = factor.update(state, settings, w, codes[t + 1])
        statistics.fold(lane, innovation[None])


def regressor(recent: Array, control: Array, settings: EstimatorSettings) -> Array:
    """w_t = [z_{t-h+1}; ...; z_t; u_t; 1?] (..., d) of codes (..., h, n) and control (..., p)."""
    past = recent.reshape(*control.shape[:-1], -1)
    constant = np.ones((*control.shape[:-1], int(settings.affine)))
    return np.concatenate([past, control, constant], axis=-1)
