"""Schedules of training."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Preset:
    """One schedule.

    Warm-up: the autoencoder alone on `warmup_steps` batches of `warmup_batch` single frames. Then
    `steps` batches of `windows` windows: each is fitted on its first `fit_frames` frames, and
    predicted from `restarts` measured histories over a horizon that grows to `horizon` frames.
    `reconstructed` and `predicted` frames of a batch are decoded. Adam, cosine decay, gradient
    norm clipped.
    """

    warmup_steps: int = 2000
    warmup_batch: int = 128
    warmup_rate: float = 3e-3
    steps: int = 4000
    windows: int = 6
    fit_frames: int = 48
    horizon: int = 20
    restarts: int = 8
    reconstructed: int = 96
    predicted: int = 192
    rate: float = 1e-3
    clip: float = 0.1
    consistency: float = 0.02
    growth: float = 0.6
    rho: float = 1e-2
    refinements: int = 2
    history: int = 2
    code_size: int = 8


PRESETS = {
    "cpu": Preset(),
    "smoke": Preset(warmup_steps=20, warmup_batch=16, steps=6, windows=2, horizon=4),
}
