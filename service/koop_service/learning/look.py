"""What a model in training predicts of trajectories that it has never seen: figures and a strip."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from koop_service.learning.evaluation import as_floats
from koop_service.learning.fit import regressors, roll_out
from koop_service.learning.recording import Recording
from koop_service.learning.train import Training
from koop_service.learning.windows import as_images

STEPS = (1, 5, 10, 20, 40, 60, 100)
"""Frames after the fit whose errors are told."""
_SHOWN = (1, *range(5, 61, 5))
_ROWS = 4
_CHANNEL = 1  # of a field; the flow's is the momentum along the stream
_GAP, _LINE, _GREY = 8, 1, 0.4  # pixels between trajectories, between frames; a line's grey


@dataclass(frozen=True, eq=False)
class Forecast:
    """Trajectories fitted on their first `fitted` frames, and predicted from there, never updated.

    `truth` and `predicted` (N, K, H, W) or (N, K, C, H, W); `last` (N, ...) is the fit's last
    frame; `dt` [s].
    """

    truth: np.ndarray
    predicted: np.ndarray
    last: np.ndarray
    dt: float

    def errors(self) -> dict[str, dict[int, float]]:
        """RMSE a pixel by frames after the fit, of the prediction and of repeating a frame."""
        steps = [step for step in STEPS if step <= self.truth.shape[1]]
        return {
            "offline": {k: _rmse(self.predicted[:, k - 1], self.truth[:, k - 1]) for k in steps},
            "offline_repeat_last": {k: _rmse(self.last, self.truth[:, k - 1]) for k in steps},
        }

    def pictures(self) -> tuple[np.ndarray, np.ndarray]:
        """Truth and prediction for the eye, (N, K, H, W): of fields one channel, the truth's range
        as [0, 1]."""
        if self.truth.ndim == 4:
            return self.truth, self.predicted
        channel = min(_CHANNEL, self.truth.shape[2] - 1)
        truth, predicted = self.truth[:, :, channel], self.predicted[:, :, channel]
        low, high = float(truth.min()), float(truth.max())
        scale = 1 / max(high - low, 1e-9)
        return (truth - low) * scale, (predicted - low) * scale


@torch.no_grad()
def forecast(training: Training, recording: Recording, fitted: int) -> Forecast:
    """What the training's model, on its device, predicts of `recording`."""
    ahead = min(max(STEPS), recording.frames.shape[1] - fitted)
    device = next(training.model.parameters()).device
    frames = torch.from_numpy(recording.frames[:, :fitted])
    controls = torch.from_numpy(recording.controls[:, : fitted + ahead - 1]).float().to(device)
    h = training.dynamics.sizes.history
    codes = torch.stack([training.model.encode(as_images(f.to(device))) for f in frames])
    theta = training.dynamics(*regressors(codes, controls[:, : fitted - 1], h))
    predicted = roll_out(theta[:, None], codes[:, None, -h:], controls[:, None, fitted - 1 :])[:, 0]
    decoded = torch.stack([training.model.decode(z) for z in predicted]).cpu().numpy()
    images = as_floats(recording.frames[:, fitted - 1 : fitted + ahead])
    pictures = decoded.reshape(images[:, 1:].shape).clip(*recording.value_range)
    return Forecast(images[:, 1:], pictures, images[:, 0], recording.dt)


def save_strip(path: Path, view: Forecast, title: str) -> bool:
    """Draw a few trajectories, truth above prediction; False where matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        return False
    shown = [k for k in _SHOWN if k <= view.truth.shape[1]]
    picture, middles = _mosaic(view, shown)
    height, width = picture.shape
    figure = Figure(figsize=(width / 90 + 1, height / 90 + 0.8), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.set_yticks(middles, ["truth", "predicted"] * (len(middles) // 2))
    size = view.truth.shape[-1]
    middles_across = [(size + _LINE) * i + (size - 1) / 2 for i in range(len(shown))]
    axes.set_xticks(middles_across, [f"{k * view.dt:.2f}" for k in shown])
    axes.set_xlabel("time after the fit [s]")
    axes.set_title(title, fontsize=10)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    partial = path.with_name(path.name + ".partial")
    figure.savefig(partial, dpi=100, format="png")
    partial.replace(path)
    return True


def _mosaic(view: Forecast, shown: list[int]) -> tuple[np.ndarray, list[float]]:
    """The strip's pixels, and the height of each row's middle."""
    rows, middles, top = [], [], 0
    for truth, predicted in list(zip(*view.pictures(), strict=True))[:_ROWS]:
        for images in (truth, predicted):
            framed = [np.pad(images[k - 1], (0, _LINE), constant_values=_GREY) for k in shown]
            rows.append(np.concatenate(framed, axis=1))
            middles.append(top + (images.shape[1] - 1) / 2)
            top += images.shape[1] + _LINE
        rows.append(np.ones((_GAP, rows[-1].shape[1])))
        top += _GAP
    return np.concatenate(rows[:-1]), middles


def _rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(((a - b) ** 2).mean()))
