"""What all training trajectories have in common: the Theta that a new one's prior is centred on."""

from __future__ import annotations

import numpy as np
import torch

from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.settings import EstimatorSettings, Rows
from koop_service.learning.recording import Recording
from koop_service.learning.streaming import regressor

_FRAMES = 20_000  # that are encoded for it, where a trajectory has no more
_TOGETHER = 250  # frames that are encoded at a time


def pooled_theta(codec: ImageCodec, recording: Recording) -> Rows:
    """Theta (n, d), the least squares of the trajectories' transitions all together (eq. 3).

    Of a large recording, of evenly chosen trajectories.
    """
    estimator, controls = codec.card.estimator, recording.controls
    settings = estimator.settings(codec.code_size, controls.shape[2])
    step = -(-recording.frames.shape[0] * recording.frames.shape[1] // _FRAMES)
    pairs = [
        _transitions(_codes(codec, recording.frames[row]), controls[row], settings)
        for row in range(0, len(recording.frames), step)
    ]
    W, Y = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return plain_rows(np.linalg.lstsq(W, Y, rcond=None)[0].T)


def plain_rows(Theta: np.ndarray | torch.Tensor) -> Rows:
    """A matrix as settings and cards hold it."""
    return tuple(tuple(row) for row in Theta.tolist())


def _codes(codec: ImageCodec, frames: np.ndarray) -> np.ndarray:
    parts = range(0, len(frames), _TOGETHER)
    return np.concatenate([codec.encode(frames[i : i + _TOGETHER]) for i in parts])


def _transitions(
    codes: np.ndarray, controls: np.ndarray, settings: EstimatorSettings
) -> tuple[np.ndarray, np.ndarray]:
    """W (K, d) and Y (K, n) of one trajectory's codes (T, n) and controls (T-1, p)."""
    h, last = settings.history, len(codes) - 1
    recent = np.stack([codes[t - h + 1 : t + 1] for t in range(h - 1, last)])
    return regressor(recent, controls[h - 1 : last], settings), codes[h:]
