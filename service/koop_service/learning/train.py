"""The training loops: the autoencoder alone, then together with the fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from tqdm import tqdm

from koop_service.encoding.autoencoder import Autoencoder, initialised
from koop_service.learning.objective import Batch, Loss, loss
from koop_service.learning.presets import Preset
from koop_service.learning.recording import Recording


def train(
    recording: Recording,
    preset: Preset,
    seed: int,
    keep: Callable[[Autoencoder], None],
    warm: Autoencoder | None = None,
) -> Autoencoder:
    """Train from scratch, or from `warm` weights; `keep` is called with the model now and then."""
    rng = np.random.default_rng(seed)
    model = _warmed_up(recording, preset, seed, rng) if warm is None else warm
    model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    keep(model)
    learn_dynamics(model, recording, preset, rng, keep)
    return model.eval()


def _warmed_up(
    recording: Recording, preset: Preset, seed: int, rng: np.random.Generator
) -> Autoencoder:
    model = initialised(preset.code_size, seed)
    model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    some = recording.frames[:: max(1, len(recording.frames) // 64)] / 255.0
    model.match_output_scale(float(some.mean()), float(some.std()))
    warm_up(model, recording, preset, rng)
    return model


def warm_up(
    model: Autoencoder, recording: Recording, preset: Preset, rng: np.random.Generator
) -> None:
    """The autoencoder alone: a prediction loss too early collapses to the mean picture."""
    model.train()
    for optimiser, progress in _steps(
        model, preset.warmup_steps, preset.warmup_rate, "autoencoder"
    ):
        images = _random_frames(recording, preset.warmup_batch, rng)
        error = ((model.decode(model.encode(images)) - images) ** 2).mean()
        _descend(model, optimiser, error, clip=1.0)
        progress.set_postfix(rmse=f"{math.sqrt(error.item()):.4f}", refresh=False)


def learn_dynamics(
    model: Autoencoder,
    recording: Recording,
    preset: Preset,
    rng: np.random.Generator,
    keep: Callable[[Autoencoder], None],
) -> None:
    """Autoencoder and prediction, the predicted horizon growing.

    BatchNorm uses its running statistics from here on, so that what is trained is what is served.
    """
    model.train()
    model.freeze_statistics()
    for step, (optimiser, progress) in enumerate(
        _steps(model, preset.steps, preset.rate, "dynamics")
    ):
        horizon = growing_horizon(step, preset)
        result = loss(model, _random_windows(recording, preset, rng), preset, horizon, rng)
        _descend(model, optimiser, result.total, preset.clip)
        progress.set_postfix(_summary(result, horizon), refresh=False)
        if step % 100 == 99:
            keep(model)


def growing_horizon(step: int, preset: Preset) -> int:
    """From 1 to `preset.horizon` over the first `preset.growth` of the steps."""
    share = min(1.0, step / max(1.0, preset.growth * preset.steps))
    return 1 + round(share * (preset.horizon - 1))


def _steps(
    model: Autoencoder, count: int, rate: float, title: str
) -> Iterator[tuple[torch.optim.Optimizer, tqdm]]:
    optimiser = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, count, eta_min=rate * 0.01)
    with tqdm(total=count, desc=title, unit="step", mininterval=1.0) as progress:
        for _ in range(count):
            yield optimiser, progress
            schedule.step()
            progress.update()


def _descend(
    model: Autoencoder, optimiser: torch.optim.Optimizer, error: torch.Tensor, clip: float
) -> None:
    optimiser.zero_grad(set_to_none=True)
    error.backward()
    norm = torch.nn.utils.clip_grad_norm_(model.parameters(), clip)
    if bool(torch.isfinite(norm)):
        optimiser.step()


def _random_frames(recording: Recording, count: int, rng: np.random.Generator) -> torch.Tensor:
    sequences, length = recording.frames.shape[:2]
    chosen = recording.frames[rng.integers(sequences, size=count), rng.integers(length, size=count)]
    images = torch.from_numpy(chosen)[:, None].float().div_(255)
    return images.contiguous(memory_format=torch.channels_last)


def _random_windows(recording: Recording, preset: Preset, rng: np.random.Generator) -> Batch:
    sequences, total = recording.frames.shape[:2]
    length = preset.length
    which = rng.integers(sequences, size=preset.windows)
    start = rng.integers(total - length + 1, size=preset.windows)
    pairs = list(zip(which, start, strict=True))
    frames = np.stack([recording.frames[i, s : s + length] for i, s in pairs])
    controls = np.stack([recording.controls[i, s : s + length - 1] for i, s in pairs])
    return Batch(torch.from_numpy(frames).float().div_(255), torch.from_numpy(controls).float())


def _summary(result: Loss, horizon: int) -> dict[str, str | int]:
    return {
        "K": horizon,
        "reconstruction": f"{result.reconstruction:.4f}",
        "prediction": f"{result.prediction:.4f}",
        "codes": f"{result.consistency:.3f}",
    }
