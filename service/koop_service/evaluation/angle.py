"""The pole's angle, read from a picture of one pole that turns about the picture's centre."""

from __future__ import annotations

import numpy as np

from koop_service.evaluation.forecasts import Array

# The rod's grey is 0.75 of the ball's; what is brighter than this share of the brightest is ball.
_BALL = 0.82


def pole_angle(pictures: Array) -> Array:
    """Angles (...) [rad] of pictures (..., H, W); 0 is upright, pi hangs, positive to the right.

    The direction from the centre to the brightest ball's centroid, weighted by brightness. NaN for
    a picture that is black.
    """
    height, width = pictures.shape[-2:]
    peak = pictures.max((-2, -1), keepdims=True)
    ball = np.maximum(pictures - _BALL * peak, 0.0)
    right = np.arange(width) - (width - 1) / 2
    up = (height - 1) / 2 - np.arange(height)
    x = (ball * right).sum((-2, -1), dtype=np.float64)
    z = (ball * up[:, None]).sum((-2, -1), dtype=np.float64)
    return np.where(peak[..., 0, 0] > 0, np.arctan2(x, z), np.nan)


def angle_error(angle: Array, truth: Array) -> Array:
    """How far apart two angles are [rad], in [0, pi]; NaN, read from a black picture, is pi."""
    apart = np.abs((angle - truth + np.pi) % (2 * np.pi) - np.pi)
    return np.where(np.isnan(apart), np.pi, apart)
