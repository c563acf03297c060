"""The weight of the prior for a fit that is never updated, chosen on the fit frames alone.

A model card's rho is chosen for a stream that is updated at every frame. A roll-out over hundreds
of frames may want another one: where the plant is only stable under its controller, a small rho
fits an unstable Theta. So the fit predicts the end of its own frames, with every candidate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.forecasts import Array, Models, Schedule, forecast

_CANDIDATES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
_FITTED = 0.6  # share of the fit frames; the others are predicted


def with_offline_rho(
    fit: Callable[[EstimatorSettings], Models],
    settings: EstimatorSettings,
    fit_frames: int,
    codes: Array,
    controls: Array,
) -> EstimatorSettings:
    """`settings` with the rho whose fit to the first fit frames best predicts the others.

    Only the first `fit_frames` of codes (N, T, n) and controls (N, T-1, p) are looked at.
    """
    known, acting = codes[:, :fit_frames], controls[:, : fit_frames - 1]
    schedule = Schedule(round(_FITTED * fit_frames))
    spread = known.var((0, 1)).mean()

    def error(candidate: EstimatorSettings) -> float:
        ahead = forecast(fit(candidate), schedule, known, acting) - known
        relative = (ahead[:, schedule.fit_frames :] ** 2).mean(2) / spread
        # Robust, as in training: how far a diverged roll-out has gone does not matter.
        return float(np.log1p(10 * relative).mean())

    return min((replace(settings, rho=rho) for rho in _CANDIDATES), key=error)
