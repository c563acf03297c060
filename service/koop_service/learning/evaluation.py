"""How well a trained model predicts trajectories that it has never seen, as the service would.

At every `stride`-th frame after warm-up the streaming estimate predicts `max(HORIZONS)` frames with
the true future controls; the decoded frames are compared with the true ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation import factor
from koop_service.estimation.proximal import solve
from koop_service.estimation.settings import EstimatorSettings
from koop_service.learning.recording import Recording
from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import rollout

HORIZONS = (1, 2, 5, 10, 20)  # frames


@dataclass(frozen=True)
class Evaluation:
    """RMSE a pixel (pixels in [0, 1]) by horizon in frames, over all trajectories and restarts."""

    reconstruction: float
    predicted: dict[int, float]
    repeat_last: dict[int, float]


def evaluate(
    codec: ImageCodec,
    recording: Recording,
    settings: EstimatorSettings,
    trajectories: int,
    stride: int = 10,
) -> Evaluation:
    """Full-update prediction errors on the first `trajectories` of `recording`."""
    parts = [
        _errors(codec, recording.frames[i], recording.controls[i], settings, stride)
        for i in range(min(trajectories, len(recording.frames)))
    ]
    reconstruction, predicted, repeated = (
        np.sqrt(np.mean(np.concatenate(errors), axis=0)) for errors in zip(*parts, strict=True)
    )
    by_horizon = range(len(HORIZONS))
    return Evaluation(
        float(reconstruction),
        {HORIZONS[i]: float(predicted[i]) for i in by_horizon},
        {HORIZONS[i]: float(repeated[i]) for i in by_horizon},
    )


def _errors(
    codec: ImageCodec,
    frames: np.ndarray,
    controls: np.ndarray,
    settings: EstimatorSettings,
    stride: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean squared pixel errors: (T,) of reconstruction, (restarts, horizons) of the other two."""
    codes = codec.encode(frames)
    images = frames / 255.0
    reconstruction = ((codec.decode(codes) - images) ** 2).mean((1, 2))
    h, steps = settings.history, np.array(HORIZONS)
    state = factor.init(settings)
    predicted, repeated = [], []
    for t in range(h - 1, len(frames) - 1):
        if t >= settings.warmup_frames and t % stride == 0 and t + steps[-1] < len(frames):
            model = _model(state, settings)
            ahead = rollout(model, codes[t - h + 1 : t + 1], controls[t : t + steps[-1]])
            truth = images[t + steps]
            decoded = codec.decode(ahead[steps - 1])
            predicted.append(((decoded - truth) ** 2).mean((1, 2)))
            repeated.append(((images[t] - truth) ** 2).mean((1, 2)))
        factor.update(state, settings, regressor(codes, controls, t, settings), codes[t + 1])
    return reconstruction, np.array(predicted), np.array(repeated)


def regressor(
    codes: np.ndarray, controls: np.ndarray, t: int, settings: EstimatorSettings
) -> np.ndarray:
    """w_t = [z_{t-h+1}; ...; z_t; u_t; 1] (d,)."""
    past = codes[t - settings.history + 1 : t + 1].ravel()
    constant = np.ones(int(settings.affine))
    return np.concatenate([past, controls[t, : settings.control_size], constant])


def _model(state: factor.Factor, settings: EstimatorSettings) -> LinearModel:
    theta = solve(state.R, state.D, settings.rho, settings.solve_iterations)
    return LinearModel.from_theta(theta, settings)
