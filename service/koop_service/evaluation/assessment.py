"""One system judged: every method's errors over time, a strip's frames and the pole's angle."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard
from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.angle import angle_error, pole_angle
from koop_service.evaluation.datasets import TestSet
from koop_service.evaluation.fits import Constant, ConstantControl, Proximal, TruncatedSVD
from koop_service.evaluation.forecasts import Array, Models, Schedule, forecast
from koop_service.evaluation.metrics import (
    decoded_errors,
    frame_at,
    rmse_over_time,
    squared_errors,
)
from koop_service.evaluation.selection import with_offline_rho
from koop_service.evaluation.systems import System
from koop_service.evaluation.trained import Trained
from koop_service.learning.dynamics import LearnedDynamics

ANGLE_HORIZON = 10.0
"""Time after the fit at which the pole's angle is read [s]."""


@dataclass(frozen=True, eq=False)
class Result:
    """What was found out about one system.

    errors: method -> (N, T) mean squared pixel errors. strip: "truth" and methods -> (T, H, W)
    uint8 of the trajectory whose offline error is the median one. angles: method -> (N,) errors of
    the pole's angle [rad] at ANGLE_HORIZON, where the picture shows it.
    """

    system: System
    card: ModelCard
    fingerprint: str
    dt: float
    errors: Mapping[str, Array]
    strip: Mapping[str, NDArray[np.uint8]]
    angles: Mapping[str, Array]

    @property
    def trajectories(self) -> int:
        """N."""
        return len(self.errors["offline"])

    @property
    def trained_frames(self) -> int | None:
        """Length of a training trajectory in frames, if the model card says."""
        frames = self.card.training.get("frames")
        return frames if isinstance(frames, int) else None

    def frame_at(self, horizon: float) -> int | None:
        """The frame `horizon` seconds after the fit, or None beyond the test set."""
        frame = frame_at(horizon, self.system.fit_frames, self.dt)
        return frame if frame < self.system.frames else None

    def rmse(self, method: str) -> Array:
        """(T,) RMSE per pixel over all trajectories."""
        return rmse_over_time(self.errors[method])


@dataclass(frozen=True, eq=False)
class _Prediction:
    """Codes (N, T, n) that one method predicts, and what decodes them.

    `until_fit` is the method that has the same codes in the fit frames, if one does.
    """

    method: str
    codec: ImageCodec
    codes: Array
    until_fit: str = ""


def assess(system: System, trained: Trained, test: TestSet) -> Result:
    """Judge every method of a system. Raises ValueError where data and weights do not fit."""
    check_fit(trained.codec, test)
    frames, controls = test.recording.frames, test.recording.controls
    codes = encode(trained.codec, frames)
    errors: dict[str, Array] = {}
    predictions = list(_predictions(system, trained, codes, frames, controls))
    for p in predictions:
        errors[p.method] = _errors(p, errors.get(p.until_fit), system.fit_frames, frames)
    errors |= _still_errors(system.fit_frames, frames, errors["reconstruction"])
    shown = _median_trajectory(errors["offline"][:, system.fit_frames :])
    strip = {p.method: p.codec.decode(p.codes[shown], np.uint8) for p in predictions}
    result = Result(
        system,
        trained.codec.card,
        trained.fingerprint,
        test.recording.dt,
        errors,
        {"truth": frames[shown], **strip},
        {},
    )
    return replace(result, angles=_angles(result, predictions, test.states))


def _errors(
    prediction: _Prediction, known: Array | None, fit_frames: int, frames: NDArray[np.uint8]
) -> Array:
    """(N, T) squared errors; those of the fit frames are copied from `known` rather than redone."""
    first = 0 if known is None else fit_frames
    codec, codes = prediction.codec, prediction.codes[:, first:]
    errors = decoded_errors(codec, codes, frames[:, first:])
    return errors if known is None else np.concatenate([known[:, :first], errors], axis=1)


def encode(codec: ImageCodec, frames: NDArray[np.uint8]) -> Array:
    """Codes (N, T, n) of frames (N, T, H, W)."""
    return np.stack([codec.encode(trajectory) for trajectory in frames])


def check_fit(codec: ImageCodec, test: TestSet) -> None:
    """Raise ValueError where the model was trained on other pictures than the test set holds."""
    card, recording = codec.card, test.recording
    if (card.renderer, card.dt) != (recording.renderer, recording.dt):
        raise ValueError(
            f"the weights were trained on frames by {card.renderer!r} every {card.dt} s, the test "
            f"set has frames by {recording.renderer!r} every {recording.dt} s; train them anew"
        )


def _predictions(
    system: System, trained: Trained, codes: Array, frames: NDArray[np.uint8], controls: Array
) -> Iterator[_Prediction]:
    """Every method that works on codes."""
    yield _Prediction("reconstruction", trained.codec, codes)
    for method, models, every in _ours(system, _settings(trained.codec, controls), codes, controls):
        predicted = forecast(models, Schedule(system.fit_frames, every), codes, controls)
        yield _Prediction(method, trained.codec, predicted, "reconstruction")
    if trained.baseline is None:
        return
    codec, learned = trained.baseline.codec, trained.baseline.learned
    codes = encode(codec, frames)
    settings = _settings(codec, controls)
    for method, models, every in _theirs(system, learned, settings, codes, controls):
        predicted = forecast(models, Schedule(system.fit_frames, every), codes, controls)
        yield _Prediction(method, codec, predicted, learned.kind)


def _settings(codec: ImageCodec, controls: Array) -> EstimatorSettings:
    return codec.card.estimator.settings(codec.code_size, controls.shape[2])


Methods = Iterator[tuple[str, Models, int | None]]


def _ours(system: System, settings: EstimatorSettings, codes: Array, controls: Array) -> Methods:
    """(method, models, frames between updates)."""
    # One fit on a stretch that is all known weighs its frames alike, as eq. 3 does; the model's
    # forgetting is for following a stream.
    once = replace(settings, forgetting=1.0)
    once = with_offline_rho(Proximal, once, system.fit_frames, codes, controls)
    yield "offline", Proximal(once), None
    yield "partial", Proximal(settings), system.partial_every
    yield "full", Proximal(settings), 1
    yield "svd", TruncatedSVD(once), None


def _theirs(
    system: System,
    learned: LearnedDynamics,
    settings: EstimatorSettings,
    codes: Array,
    controls: Array,
) -> Methods:
    if learned.kind == "learned-A":
        yield "learned-A", Constant(learned.matrix, settings), None
        return
    fit = partial(ConstantControl, learned.matrix)
    once = replace(settings, forgetting=1.0)
    once = with_offline_rho(fit, once, system.fit_frames, codes, controls)
    yield "learned-B", fit(once), None
    following = fit(settings)
    yield "learned-B-partial", following, system.partial_every
    yield "learned-B-full", following, 1


def _still_errors(
    fit_frames: int, frames: NDArray[np.uint8], reconstruction: Array
) -> dict[str, Array]:
    """Two methods without a model: the last fit frame repeated, and the mean picture.

    The mean is over the fit frames of all the test trajectories: it sees nothing that is predicted.
    """
    fitted = frames[:, :fit_frames]
    mean = fitted.mean((0, 1)) / 255
    guesses = {
        "repeat-last": fitted[:, -1] / 255,
        "mean-frame": np.broadcast_to(mean, (len(frames), *mean.shape)),
    }
    return {
        name: _still(guess, fit_frames, frames, reconstruction) for name, guess in guesses.items()
    }


def _still(
    guesses: Array, fit_frames: int, frames: NDArray[np.uint8], reconstruction: Array
) -> Array:
    """(N, T) errors of one guess (H, W) a trajectory for all that comes after the fit."""
    errors = reconstruction.copy()
    for i, guess in enumerate(guesses):
        errors[i, fit_frames:] = squared_errors(guess.astype(np.float32), frames[i, fit_frames:])
    return errors


def _median_trajectory(errors: Array) -> int:
    """Which trajectory's error is the median one: neither the best nor the worst is shown."""
    return int(np.argsort(errors.mean(1))[len(errors) // 2])


def _angles(result: Result, predictions: list[_Prediction], states: Array) -> dict[str, Array]:
    """Errors (N,) of the pole's angle [rad], read from each method's decoded pictures."""
    frame = result.frame_at(ANGLE_HORIZON)
    if not result.system.reads_angle or frame is None:
        return {}
    truth = states[:, frame, 0]
    return {
        p.method: angle_error(pole_angle(p.codec.decode(p.codes[:, frame])), truth)
        for p in predictions
    }
