"""Asking for controls to a target, and the answer (the paper's eq. 13)."""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field

import numpy as np
from numpy.typing import NDArray

from koop_protocol import checks
from koop_protocol.errors import ErrorCode, ProtocolError
from koop_protocol.keys import check_trajectory
from koop_protocol.limits import DEFAULT_LIMITS, Limits
from koop_protocol.predictions import check_horizon, check_rows
from koop_protocol.weights import Weights, check_sizes, check_weights

LQR_PARTS = frozenset({"codes", "frames"})
_NOTHING_MORE: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class LqrQuery:
    """Bring the system to a target: minimise the sum over t = 1..N of
    (z_t - z_f)^T Q (z_t - z_f) + u_t^T R u_t, with u_min <= u_t <= u_max.

    Attributes:
        horizon: number of steps N.
        target_image: (H, W) or (C, H, W), of the stream's shape and dtype; or None.
        target_code: (n,) float64; or None. Exactly one of the two targets is given.
        q: weight Q on the code: a number (times the identity), (n,) diagonal or (n, n) matrix;
            positive semidefinite.
        r: weight R on the control: a number, (p,) or (p, p); positive definite.
        u_min: (p,) lower bound, in the control's unit; None is no bound.
        u_max: (p,) upper bound; None is no bound.
        returns: what to send back beside the controls, of "codes" and "frames".
    """

    horizon: int
    target_image: checks.Image | None = None
    target_code: checks.Floats | None = None
    q: Weights = 1.0
    r: Weights = 1.0
    u_min: checks.Floats | None = None
    u_max: checks.Floats | None = None
    returns: frozenset[str] = _NOTHING_MORE
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        put(self, "horizon", check_horizon(self.horizon, limits))
        self._check_target(limits)
        self._check_bounds(limits)
        put(self, "q", check_weights("q", self.q, limits.max_code_size, definite=False))
        put(self, "r", check_weights("r", self.r, limits.max_control_size, definite=True))
        check_sizes(ErrorCode.bad_weights, q=self.q, target_code=self.target_code)
        check_sizes(ErrorCode.bad_bounds, r=self.r, u_min=self.u_min, u_max=self.u_max)
        put(self, "returns", checks.choices("returns", self.returns, LQR_PARTS))

    def _check_target(self, limits: Limits) -> None:
        if (self.target_image is None) == (self.target_code is None):
            found = "neither" if self.target_image is None else "both"
            raise ProtocolError(
                ErrorCode.bad_target,
                f"{found} of target_image and target_code given",
                "exactly one of them",
                "send the picture to reach, or the code of it",
                {"field": "target_image"},
            )
        if self.target_code is not None:
            code = checks.vector("target_code", self.target_code, limits.max_code_size)
            object.__setattr__(self, "target_code", code)
        else:
            checks.image("target_image", self.target_image, limits.max_image_values)

    def _check_bounds(self, limits: Limits) -> None:
        for name in ("u_min", "u_max"):
            bound: object = getattr(self, name)
            if bound is not None:
                checked = checks.vector(name, bound, limits.max_control_size)
                object.__setattr__(self, name, checked)
        low, high = self.u_min, self.u_max
        if low is None or high is None or low.shape != high.shape:
            return
        if (low > high).any():
            at = int(np.argmax(low > high))
            raise checks.fault(
                ErrorCode.bad_bounds,
                "u_min",
                f"is above u_max in component {at}: {low[at]} > {high[at]}",
                "u_min <= u_max in every component",
            )


@dataclass(frozen=True, eq=False)
class LqrReply:
    """Controls to the target and what the model expects of them.

    Attributes:
        trajectory: its name.
        epoch: the source's run.
        seq: the last frame that the service had folded; ``controls[i]`` acts between the frames
            seq + i and seq + i + 1.
        status: the solver's outcome, "solved" where the controls are optimal.
        cost: the objective, constant part included.
        kkt_residual: largest violation of the optimality conditions, computed by the service.
        controls: (N, p) float64, in the control's unit.
        codes: (N, n) predicted codes, or None if not asked for.
        frames: (N, ...) predicted frames of the stream's own shape and dtype, or None.
        target_error: RMSE of the autoencoder's reconstruction of the target image, in the image's
            unit; 0 where the target was a code.
    """

    trajectory: str
    epoch: str
    seq: int
    status: str
    cost: float
    kkt_residual: float
    controls: checks.Floats
    codes: NDArray[np.floating] | None = None
    frames: checks.Image | None = None
    target_error: float = 0.0
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        check_trajectory(self.trajectory, limits.max_name_length)
        checks.epoch("epoch", self.epoch)
        put(self, "seq", checks.sequence("seq", self.seq))
        checks.text("status", self.status, limits.max_name_length)
        put(self, "cost", checks.real("cost", self.cost))
        put(self, "kkt_residual", checks.real("kkt_residual", self.kkt_residual, 0.0))
        put(self, "target_error", checks.real("target_error", self.target_error, 0.0))
        controls = checks.table(
            "controls", self.controls, limits.max_horizon, limits.max_control_size
        )
        put(self, "controls", np.asarray(controls, np.float64))
        check_rows({"codes": self.codes}, self.frames, limits, controls=controls.shape[0])
