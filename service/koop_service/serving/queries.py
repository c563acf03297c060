"""What the service answers about one trajectory: a prediction, controls to a target, its state.

Each function takes a trajectory and a query and returns the reply, or raises ProtocolError with
what the caller should know. Nothing here knows how questions come and answers go.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from koop_protocol import (
    ErrorCode,
    LqrQuery,
    LqrReply,
    PredictQuery,
    PredictReply,
    ProtocolError,
    StateReply,
)
from koop_protocol.checks import Image
from koop_service.control.problem import build_lqr
from koop_service.control.solve import QPSolution, solve_qp
from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import rollout
from koop_service.prediction.uncertainty import calibrated, rollout_std
from koop_service.serving.trajectories import Trajectory, check_range

Array = NDArray[np.float64]

MAX_PLANNED = 400
"""Most numbers in a control sequence (N*p): the QP's time grows with its cube, to about 50 ms."""


def predict(trajectory: Trajectory, query: PredictQuery) -> PredictReply:
    """Roll the present model out from the last folded frame (eq. 8)."""
    model, history = _model_and_history(trajectory)
    controls = _controls(trajectory, query)
    codes = _finite(rollout(model, history, controls))
    std = _std(trajectory, model, history, controls) if "std" in query.returns else None
    return PredictReply(
        trajectory.name,
        trajectory.epoch,
        trajectory.last_seq,
        codes if "codes" in query.returns else None,
        _pictures(trajectory, codes) if "frames" in query.returns else None,
        std,
    )


def control(trajectory: Trajectory, query: LqrQuery) -> LqrReply:
    """Controls that bring the trajectory to a target (eq. 13), and what they should lead to."""
    model, history = _model_and_history(trajectory)
    _check_sizes(trajectory, query)
    target, target_error = _target(trajectory, query)
    solution = _solve(model, history, target, query)
    codes = _finite(rollout(model, history, solution.u)) if query.returns else None
    return LqrReply(
        trajectory.name,
        trajectory.epoch,
        trajectory.last_seq,
        solution.status,
        solution.cost,
        solution.kkt_residual,
        solution.u,
        codes if "codes" in query.returns else None,
        _pictures(trajectory, codes) if codes is not None and "frames" in query.returns else None,
        target_error,
    )


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


def _model_and_history(trajectory: Trajectory) -> tuple[LinearModel, Array]:
    have, need = trajectory.warmup
    history = trajectory.stream.history
    if have < need:
        raise ProtocolError(
            ErrorCode.warming_up,
            f"warming up, {have} of {need} frames",
            details={"frames": have, "warmup_frames": need},
        )
    if history is None:
        raise ProtocolError(
            ErrorCode.warming_up,
            "frames were missed a moment ago",
            f"{trajectory.settings.history} frames in a row",
            "ask again after the next frames",
            {"frames": have, "warmup_frames": need},
        )
    return trajectory.model(), history


def _std(trajectory: Trajectory, model: LinearModel, history: Array, controls: Array) -> Array:
    """(H, n): what the posterior says, corrected as the model's held-out trajectories showed."""
    posterior, card = trajectory.posterior(), trajectory.entry.card
    std = rollout_std(model, history, controls, posterior.S, posterior.R, trajectory.settings.rho)
    return _finite(calibrated(std, card.estimator.band_scale))


def _controls(trajectory: Trajectory, query: PredictQuery) -> Array:
    """(H, p): the query's, or the last one known held still."""
    size = trajectory.settings.control_size
    if query.controls is None:
        held = trajectory.stream.last_control
        u = np.zeros(size) if held is None else held[1]
        return np.tile(u, (query.horizon, 1))
    if query.controls.shape[1] != size:
        raise ProtocolError(
            ErrorCode.bad_controls,
            f"controls have {query.controls.shape[1]} components",
            f"{size}, as the trajectory {trajectory.name!r} has"
            if size
            else f"none, since the trajectory {trajectory.name!r} is not actuated",
            details={"control_size": size},
        )
    return query.controls


def _finite(codes: Array) -> Array:
    if not np.isfinite(codes).all():
        raise ProtocolError(
            ErrorCode.bad_horizon,
            f"the present model is unstable: over {len(codes)} steps its prediction overflows",
            "a prediction of finite numbers",
            "ask for a shorter horizon, or let the model see more frames",
        )
    return codes


def _pictures(trajectory: Trajectory, codes: Array) -> Image:
    return trajectory.codec.decode(codes, trajectory.dtype)


def _check_sizes(trajectory: Trajectory, query: LqrQuery) -> None:
    n, p = trajectory.settings.code_size, trajectory.settings.control_size
    if p == 0:
        raise ProtocolError(
            ErrorCode.bad_controls,
            f"the trajectory {trajectory.name!r} is not actuated: its frames say control_size 0",
            "an actuated one",
            "stream with controls (koop-sim-client --actuated)",
        )
    if query.horizon * p > MAX_PLANNED:
        raise ProtocolError(
            ErrorCode.bad_horizon,
            f"horizon is {query.horizon}",
            f"at most {MAX_PLANNED // p} steps with {p} controls",
            "plan less far ahead, and again at later frames",
            {"field": "horizon", "limit": MAX_PLANNED // p},
        )
    for name, value, what, size, code in (
        ("target_code", query.target_code, "code", n, ErrorCode.bad_target),
        ("q", query.q, "code", n, ErrorCode.bad_weights),
        ("r", query.r, "control", p, ErrorCode.bad_weights),
        ("u_min", query.u_min, "control", p, ErrorCode.bad_bounds),
        ("u_max", query.u_max, "control", p, ErrorCode.bad_bounds),
    ):
        if isinstance(value, np.ndarray) and value.shape[0] != size:
            raise ProtocolError(
                code,
                f"{name} has size {value.shape[0]}",
                f"{size}, the size of a {what} of {trajectory.name!r}",
                details={"field": name, "size": size},
            )


def _target(trajectory: Trajectory, query: LqrQuery) -> tuple[Array, float]:
    """The target's code (n,), and how well the autoencoder can show the target at all (RMSE)."""
    if query.target_code is not None:
        return query.target_code, 0.0
    image = np.asarray(query.target_image)
    if image.shape != trajectory.codec.image_shape:
        raise ProtocolError(
            ErrorCode.bad_target,
            f"target_image has shape {image.shape}",
            f"{trajectory.codec.image_shape}, as the model {trajectory.entry.name!r} takes",
            details={"field": "target_image"},
        )
    check_range(image, ErrorCode.bad_target, "target_image")
    codes = trajectory.codec.encode(image[None])
    shown = trajectory.codec.decode(codes, image.dtype)[0]
    difference = shown.astype(np.float64) - image.astype(np.float64)
    return codes[0], float(np.sqrt(np.mean(difference**2)))


def _solve(model: LinearModel, history: Array, target: Array, query: LqrQuery) -> QPSolution:
    try:
        # Without a terminal weight the cost is eq. 13's, and closed loops on the simulator succeed.
        bounds = (query.u_min, query.u_max)
        qp = build_lqr(model, history, target, query.horizon, query.q, query.r, *bounds, Qf=None)
    except ValueError as error:
        raise ProtocolError(ErrorCode.bad_weights, str(error)) from error
    solution = solve_qp(qp)
    if not np.isfinite(solution.cost) or not np.isfinite(solution.kkt_residual):
        raise ProtocolError(
            ErrorCode.bad_horizon,
            f"the present model is unstable: over {query.horizon} steps the cost overflows",
            "a cost that is a finite number",
            "ask for a shorter horizon, or let the model see more frames",
        )
    return solution
