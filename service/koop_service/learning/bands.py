"""How often the truth lies within a prediction's bands, and the factors that make it often enough.

Split conformal prediction: on held-out trajectories, streamed as the service would see them, the
factor of a horizon is the ratio of error to standard deviation that 90% of the codes stay below,
over a Gaussian's. The level 90% is met, whatever the errors' distribution; others follow it as far
as that is Gaussian.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from statistics import NormalDist

import numpy as np

from koop_service.encoding.weights import EstimatorDefaults
from koop_service.learning.streaming import Encoded, moments
from koop_service.prediction.rollout import rollout
from koop_service.prediction.uncertainty import SCALE_HORIZONS, calibrated, rollout_std

LEVEL = 0.9


def half_width(level: float) -> float:
    """Of the band that holds `level` of a Gaussian, in standard deviations."""
    return NormalDist().inv_cdf((1 + level) / 2)


def ratios(trajectories: list[Encoded], defaults: EstimatorDefaults) -> np.ndarray:
    """|error| over standard deviation, (moments, horizons, n) at SCALE_HORIZONS.

    NaN where nothing can be said: a component that never moves, a roll-out that overflows (the
    service refuses it).
    """
    found = [r for trajectory in trajectories for r in _ratios(trajectory, defaults)]
    n = trajectories[0].codes.shape[1]
    return np.array(found).reshape(-1, len(SCALE_HORIZONS), n)


def coverage(ratios: np.ndarray, level: float) -> np.ndarray:
    """(horizons,) share of the truth within the `level` bands."""
    known = np.isfinite(ratios)
    return (ratios < half_width(level)).sum((0, 2)) / np.maximum(known.sum((0, 2)), 1)


def band_scale(trajectories: list[Encoded], defaults: EstimatorDefaults) -> tuple[float, ...]:
    """The factors of `defaults` that make 90% bands hold 90%; none where nothing can be said."""
    raw = ratios(trajectories, dataclasses.replace(defaults, band_scale=()))
    known = [r[np.isfinite(r)] for r in raw.swapaxes(0, 1)]
    factors = [float(np.quantile(r, LEVEL)) / half_width(LEVEL) for r in known if r.size]
    useful = len(factors) == len(SCALE_HORIZONS) and min(factors) > 0
    return tuple(float(f"{factor:.4g}") for factor in factors) if useful else ()


def _ratios(trajectory: Encoded, defaults: EstimatorDefaults) -> Iterator[np.ndarray]:
    """(horizons, n) of each moment of one trajectory."""
    settings = defaults.settings(trajectory.codes.shape[1], trajectory.controls.shape[1])
    at = np.array(SCALE_HORIZONS) - 1
    for m in moments(trajectory, settings, max(SCALE_HORIZONS)):
        error = np.abs(m.future - rollout(m.model, m.history, m.controls))
        std = rollout_std(m.model, m.history, m.controls, m.S, m.R, settings.ignorance)
        std = calibrated(std, defaults.band_scale)
        # What never moves is predicted to the last bit.
        known = np.isfinite(error) & np.isfinite(std) & (error > 0) & (std > 0)
        ratio = np.divide(error, std, out=np.full(std.shape, np.nan), where=known)
        yield ratio[at]
