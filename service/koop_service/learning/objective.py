"""The training loss: eq. 12 and 17 with restarts (the paper's partial updates).

Long open-loop roll-outs of a plant that is unstable without its controller explode. So the model is
fitted on a window's first frames and rolled out over short segments from many measured restarts,
inside the fitted part and after it. A robust consistency term in code space reaches every predicted
step; a random part of them is decoded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from koop_service.encoding.autoencoder import Autoencoder
from koop_service.learning.fit import proximal_solve, regressors, roll_out
from koop_service.learning.presets import Preset


@dataclass(frozen=True, eq=False)
class Batch:
    """Windows: images (B, T, 64, 64) in [0, 1] and controls (B, T-1, p), both float32."""

    images: Tensor
    controls: Tensor


@dataclass(frozen=True, eq=False)
class Loss:
    """`total` is minimised; the others are (robust) RMSE a pixel and relative RMSE of codes."""

    total: Tensor
    reconstruction: float
    prediction: float
    consistency: float


def loss(
    model: Autoencoder, batch: Batch, preset: Preset, horizon: int, rng: np.random.Generator
) -> Loss:
    """Reconstruction, decoded prediction and code consistency over `horizon` steps."""
    windows, length = batch.images.shape[:2]
    flat = batch.images.flatten(0, 1)[:, None].contiguous(memory_format=torch.channels_last)
    codes = model.encode(flat).unflatten(0, (windows, length))
    fitted = int(rng.integers(preset.fit_frames[0], preset.fit_frames[1] + 1))
    W, Y = regressors(codes[:, :fitted], batch.controls[:, : fitted - 1], preset.history)
    theta = proximal_solve(W, Y, preset.rho, preset.refinements)

    restarts = _restarts(windows, fitted, length - 1 - horizon, preset, rng)
    predicted, target_index = _predict(theta, codes, batch.controls, restarts, horizon, preset)
    targets = _pick(codes, target_index)
    spread = codes.detach().flatten(0, 1).var(0).mean()
    relative = ((predicted - targets) ** 2).mean(3) / spread
    consistency = torch.log1p(10 * relative).mean() / 10

    reconstruction = _decoded_error(model, codes, batch.images, preset.reconstructed, rng)
    aimed = batch.images[torch.arange(windows)[:, None, None], target_index]
    prediction = _decoded_error(model, predicted, aimed, preset.predicted, rng)
    total = reconstruction + prediction + preset.consistency * consistency
    return Loss(
        total,
        float(reconstruction.detach().sqrt()),
        float(prediction.detach().sqrt()),
        float(relative.detach().mean().sqrt()),
    )


def _restarts(
    windows: int, fitted: int, last: int, preset: Preset, rng: np.random.Generator
) -> Tensor:
    """Frames (B, S) to start from: half inside the fitted part, half from its end to `last`."""
    half = preset.restarts // 2
    inside = rng.integers(preset.history - 1, fitted - 1, (windows, half))
    after = rng.integers(fitted - 1, last + 1, (windows, preset.restarts - half))
    return torch.from_numpy(np.concatenate([inside, after], 1))


def _predict(
    theta: Tensor, codes: Tensor, controls: Tensor, restarts: Tensor, horizon: int, preset: Preset
) -> tuple[Tensor, Tensor]:
    """Predicted codes (B, S, K, n) and the frames (B, S, K) that they predict."""
    steps = torch.arange(horizon)
    back = torch.arange(1 - preset.history, 1)
    history = _pick(codes, restarts[:, :, None] + back)
    future = _pick(controls, restarts[:, :, None] + steps)
    return roll_out(theta, history, future), restarts[:, :, None] + 1 + steps


def _pick(sequence: Tensor, index: Tensor) -> Tensor:
    """sequence (B, T, c) at index (B, S, K): (B, S, K, c)."""
    return sequence[torch.arange(len(sequence))[:, None, None], index]


def _decoded_error(
    model: Autoencoder, codes: Tensor, images: Tensor, count: int, rng: np.random.Generator
) -> Tensor:
    """Squared pixel error of `count` randomly chosen codes (..., n) decoded, robust by picture.

    A diverged code decodes to anything; its error counts no more than logarithmically beyond the
    pictures' own variance, or one of them would drown a whole batch.
    """
    flat_codes, flat_images = codes.flatten(0, -2), images.flatten(0, -3)
    chosen = torch.from_numpy(rng.choice(len(flat_codes), min(count, len(flat_codes)), False))
    decoded = model.decode(flat_codes[chosen])
    truth = flat_images[chosen]
    error = ((decoded[:, 0] - truth) ** 2).mean((1, 2))
    scale = truth.var()
    return (scale * torch.log1p(error / scale)).mean()
