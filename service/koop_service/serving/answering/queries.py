"""What the service answers about one trajectory: a prediction, controls to a target, its state.

Each function takes a trajectory and a query and returns the reply, or raises ProtocolError with
what the caller should know. Nothing here knows how questions come and answers go.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from koop_protocol import (
    ErrorCode,
    Limits,
    LqrQuery,
    LqrReply,
    PredictQuery,
    PredictReply,
    ProtocolError,
    StateReply,
)
from koop_service.prediction.model import LinearModel
from koop_service.prediction.uncertainty import calibrated, rollout_std
from koop_service.serving.steering.outset import set_out
from koop_service.serving.trajectories.forecasts import finite, forecast
from koop_service.serving.trajectories.trajectory import Trajectory, check_size

Array = NDArray[np.float64]

_ENVELOPE = 4096
"""Bytes of a reply that do not grow with its steps."""


def predict(trajectory: Trajectory, query: PredictQuery, limits: Limits) -> PredictReply:
    """Roll the present model out from the last folded frame (eq. 8); `limits` are the reply's."""
    _check_room(trajectory, query, limits)
    history, model = trajectory.recent_codes(), trajectory.model()
    controls = _controls(trajectory, query)
    codes = forecast(model, history, controls)
    std = _std(trajectory, model, history, controls) if "std" in query.returns else None
    return PredictReply(
        trajectory.name,
        trajectory.epoch,
        trajectory.last_seq,
        codes if "codes" in query.returns else None,
        trajectory.show(codes) if "frames" in query.returns else None,
        std,
    )


def control(trajectory: Trajectory, query: LqrQuery, limits: Limits) -> LqrReply:
    """Controls that bring the trajectory to a target (eq. 13), and what they should lead to."""
    _check_room(trajectory, query, limits)
    return set_out(trajectory, query).reply


def state(trajectory: Trajectory) -> StateReply:
    """Where the trajectory's estimator stands."""
    settings, ready = trajectory.settings, trajectory.ready
    status = trajectory.bank.status(trajectory.lane)
    return StateReply(
        trajectory=trajectory.name,
        epoch=trajectory.epoch,
        next_seq=trajectory.stream.next_seq,
        model=trajectory.entry.name,
        code_size=settings.code_size,
        history=settings.history,
        control_size=settings.control_size,
        frames=trajectory.stream.frames,
        updates=status.updates,
        warmup_frames=settings.warmup_frames,
        ready=ready,
        residual_rms=status.residual_rms,
        spectral_radius=trajectory.model().spectral_radius() if ready else 0.0,
        excitation=status.excitation if ready else 0.0,
        counters=trajectory.counters(),
    )


def _check_room(trajectory: Trajectory, query: PredictQuery | LqrQuery, limits: Limits) -> None:
    """ProtocolError (too_large), before they are drawn, for more frames than a reply can hold."""
    if "frames" not in query.returns:
        return
    shape, dtype = tuple(trajectory.codec.image_shape), trajectory.dtype
    settings = trajectory.settings
    frame = math.prod(shape) * dtype.itemsize
    numbers = 8 * (2 * settings.code_size + settings.control_size)
    most = max(0, limits.max_message_bytes - _ENVELOPE) // (frame + numbers)
    if query.horizon > most:
        raise ProtocolError(
            ErrorCode.too_large,
            f"{query.horizon} frames of {shape} {dtype} have {query.horizon * frame / 1e6:.1f} MB",
            f"at most {most} in one reply",
            "ask for fewer steps or for codes only, or start koop-serve with a larger "
            "--max-reply-bytes",
            {"limit": limits.max_message_bytes, "frames": most},
        )


def _std(trajectory: Trajectory, model: LinearModel, history: Array, controls: Array) -> Array:
    """(H, n): what the posterior says, corrected as the model's held-out trajectories showed."""
    posterior, card = trajectory.posterior(), trajectory.entry.card
    ignorance = trajectory.settings.ignorance
    std = rollout_std(model, history, controls, posterior.S, posterior.R, ignorance)
    return finite(calibrated(std, card.estimator.band_scale))


def _controls(trajectory: Trajectory, query: PredictQuery) -> Array:
    """(H, p): the query's, or the last one known held still."""
    size = trajectory.settings.control_size
    if query.controls is None:
        return np.tile(trajectory.last_control(), (query.horizon, 1))
    if query.controls.shape[1] != size:
        raise ProtocolError(
            ErrorCode.bad_controls,
            f"controls have {query.controls.shape[1]} components",
            f"{size}, as the trajectory {trajectory.name!r} has"
            if size
            else f"none, since the trajectory {trajectory.name!r} is not actuated",
            details={"control_size": size},
        )
    check_size(query.controls, ErrorCode.bad_controls, "controls")
    return query.controls
