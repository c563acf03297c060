"""Schedules of training."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Preset:
    """One schedule.

    Warm-up: the autoencoder alone on `warmup_steps` batches of `warmup_batch` single frames. Then
    `steps` batches of `windows` windows of `length` frames: each is fitted on its first frames, as
    many as drawn from `fit_frames` for the batch, and predicted from `restarts` measured histories
    over a horizon that grows to `horizon` frames within the share `growth` of the steps.
    `reconstructed` and `predicted` frames of a batch are decoded. Adam, cosine decay, gradient norm
    clipped.
    """

    warmup_steps: int = 4000
    warmup_batch: int = 128
    warmup_rate: float = 3e-3
    steps: int = 4000
    windows: int = 4
    length: int = 112
    fit_frames: tuple[int, int] = (40, 88)
    horizon: int = 20
    restarts: int = 8
    reconstructed: int = 96
    predicted: int = 192
    rate: float = 1e-3
    clip: float = 0.1
    consistency: float = 0.02
    growth: float = 0.4
    rho: float = 1e-2
    refinements: int = 2
    history: int = 2
    code_size: int = 8


PRESETS = {
    "cpu": Preset(),
    "smoke": Preset(warmup_steps=20, warmup_batch=16, steps=6, windows=2, horizon=4),
}
