"""How well a trained model predicts trajectories that it has never seen, as the service would.

At every `STRIDE`-th frame after warm-up the streaming estimate predicts `max(HORIZONS)` frames with
the true future controls; the decoded frames are compared with the true ones.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import EstimatorDefaults
from koop_service.estimation.settings import EstimatorSettings, Rows
from koop_service.learning.recording import Recording
from koop_service.learning.streaming import STRIDE, Encoded, moments
from koop_service.prediction.rollout import rollout

HORIZONS = (1, 2, 5, 10, 20)  # frames

# What `select` chooses from.
_FORGETTING = (0.95, 0.97, 0.985, 1.0)
_RHO = (1e-4, 1e-3, 1e-2, 1e-1)
_RHO_AROUND_MEAN = (1e-2, 1e-1, 1.0, 10.0)
_TOLERANCE = 1.1


@dataclass(frozen=True)
class Evaluation:
    """RMSE a value (pictures in [0, 1], fields as recorded), over all trajectories and restarts.

    `predicted` and `repeat_last` by horizon in frames.
    """

    reconstruction: float
    predicted: dict[int, float]
    repeat_last: dict[int, float]


def encode_all(codec: ImageCodec, recording: Recording) -> list[Encoded]:
    """Every trajectory of `recording` with its codes."""
    return [
        Encoded(as_floats(frames), codec.encode(frames), controls)
        for frames, controls in zip(recording.frames, recording.controls, strict=True)
    ]


def frames_needed(settings: EstimatorSettings) -> int:
    """Frames of the shortest trajectory that can be judged, at one moment."""
    first = -(-settings.warmup_frames // STRIDE) * STRIDE
    return first + max(HORIZONS) + 1


def as_floats(frames: np.ndarray) -> np.ndarray:
    """Frames as float32, uint8 ones in [0, 1]."""
    return frames / np.float32(255) if frames.dtype == np.uint8 else frames.astype(np.float32)


def evaluate(
    codec: ImageCodec, trajectories: list[Encoded], defaults: EstimatorDefaults
) -> Evaluation:
    """Prediction errors with an estimate updated at every frame (the paper's full updates)."""
    errors = [_errors(codec, trajectory, defaults) for trajectory in trajectories]
    predicted, repeated = (
        np.sqrt(np.concatenate(part).mean(0)) for part in zip(*errors, strict=True)
    )
    squared = [((codec.decode(t.codes) - t.images) ** 2).mean() for t in trajectories]
    return Evaluation(
        float(np.sqrt(np.mean(squared))),
        dict(zip(HORIZONS, predicted.tolist(), strict=True)),
        dict(zip(HORIZONS, repeated.tolist(), strict=True)),
    )


def select(
    trajectories: list[Encoded], defaults: EstimatorDefaults, mean: Rows = ()
) -> EstimatorDefaults:
    """Forgetting, rho and the prior's mean (zero, or `mean`) with the least code error.

    It is taken over all horizons. Of choices within `_TOLERANCE` of the best, the one that forgets
    fastest: the held-out plants never change, a user's may.
    """
    errors = {
        choice: _code_error(trajectories, choice)
        for choice in (
            dataclasses.replace(defaults, forgetting=forgetting, rho=rho, prior_mean=centre)
            for centre, weights in (((), _RHO), (mean, _RHO_AROUND_MEAN))[: 2 if mean else 1]
            for forgetting, rho in itertools.product(_FORGETTING, weights)
        )
    }
    least = min(errors.values())
    good = [choice for choice, error in errors.items() if error <= _TOLERANCE * least]
    return min(good, key=lambda choice: (choice.forgetting, errors[choice]))


def _code_error(trajectories: list[Encoded], defaults: EstimatorDefaults) -> float:
    """Mean over horizons of log relative code error: robust, since some restarts diverge."""
    spread = np.concatenate([t.codes for t in trajectories]).var(0).mean()
    logs = [
        np.log1p(10 * ((ahead - t.codes[start + 1 : start + 1 + len(ahead)]) ** 2) / spread)
        for t in trajectories
        for start, ahead in _predictions(t, defaults)
    ]
    return float(np.mean(logs))


def _errors(
    codec: ImageCodec, trajectory: Encoded, defaults: EstimatorDefaults
) -> tuple[np.ndarray, np.ndarray]:
    """Mean squared pixel errors (restarts, horizons) of prediction and of repeating a frame."""
    steps = np.array(HORIZONS)
    predicted, repeated = [], []
    for start, ahead in _predictions(trajectory, defaults):
        truth = trajectory.images[start + steps]
        decoded = codec.decode(ahead[steps - 1])
        predicted.append(_mean_squares(decoded - truth))
        repeated.append(_mean_squares(trajectory.images[start] - truth))
    return np.array(predicted), np.array(repeated)


def _mean_squares(errors: np.ndarray) -> np.ndarray:
    """(K,) of errors (K, ...)."""
    return (errors**2).reshape(len(errors), -1).mean(1)


def _predictions(
    trajectory: Encoded, defaults: EstimatorDefaults
) -> Iterator[tuple[int, np.ndarray]]:
    """(last known frame, predicted codes (K, n)) along one trajectory, as it streams."""
    settings = defaults.settings(trajectory.codes.shape[1], trajectory.controls.shape[1])
    for m in moments(trajectory, settings, max(HORIZONS)):
        yield m.t, rollout(m.model, m.history, m.controls)
