"""Asking for controls to a target, and the answer (the paper's eq. 13)."""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field

import numpy as np
from numpy.typing import NDArray

from koop_protocol import checks
from koop_protocol.errors import ErrorCode, ProtocolError
from koop_protocol.keys import check_trajectory
from koop_protocol.limits import DEFAULT_LIMITS, MAX_SEQUENCE, MAX_TEXT_BYTES, Limits
from koop_protocol.predictions import check_horizon, check_rows
from koop_protocol.weights import Weights, check_sizes, check_weights

LQR_PARTS = frozenset({"codes", "frames"})
LQR_METHODS = frozenset({"qp", "gain"})
TERMINAL_WEIGHTS = frozenset({"riccati"})
_NOTHING_MORE: frozenset[str] = frozenset()
_BOUNDS = ("u_min", "u_max", "du_min", "du_max")
_MODE_COLUMNS = 4
_AS_SEQ = -1


@dataclass(frozen=True, eq=False)
class LqrQuery:
    """Bring the system to a target: minimise the sum over t = 1..N of
    (z_t - r_t)^T Q (z_t - r_t) + u_{t-1}^T R u_{t-1}, with u_min <= u_t <= u_max and
    du_min <= u_t - u_{t-1} <= du_max.

    Attributes:
        horizon: number of steps N.
        target_image: the picture to reach, of the stream's shape and dtype, or (K, ...) of them:
            row i is the target of step i+1, the last row stays; or None.
        target_code: (n,) or (K, n) float64, likewise; or None. Exactly one of the two is given.
        q: weight Q on the code: a number (times the identity), (n,) diagonal or (n, n) matrix;
            positive semidefinite.
        r: weight R on the control: a number, (p,) or (p, p); positive definite.
        u_min: (p,) lower bound, in the control's unit; None is no bound.
        u_max: (p,) upper bound; None is no bound.
        returns: what to send back beside the controls, of "codes" and "frames".
        qf: weight of the last step in Q's place; "riccati": what going on for ever costs; None: Q.
        du_min: (p,) lower bound, at most 0, on a control's change in one step; None is no bound.
        du_max: (p,) upper bound, at least 0.
        known_channels: channels of the control that are given, not decided; None is none.
        known_controls: (K, m) float64, the future of those m channels, the last row stays.
        delay: frames between a frame and the first control that can still act on the system.
        method: "qp" plans inside the bounds; "gain" cuts the infinite horizon's gain off at them.
        force: whether to give controls although the model is not fit for control.
    """

    horizon: int
    target_image: checks.Image | None = None
    target_code: checks.Floats | None = None
    q: Weights = 1.0
    r: Weights = 1.0
    u_min: checks.Floats | None = None
    u_max: checks.Floats | None = None
    returns: frozenset[str] = _NOTHING_MORE
    qf: Weights | str | None = None
    du_min: checks.Floats | None = None
    du_max: checks.Floats | None = None
    known_channels: tuple[int, ...] | None = None
    known_controls: checks.Floats | None = None
    delay: int = 0
    method: str = "qp"
    force: bool = False
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        put(self, "horizon", check_horizon(self.horizon, limits))
        self._check_target(limits)
        self._check_bounds(limits)
        self._check_known(limits)
        self._check_weights(limits)
        put(self, "returns", checks.choices("returns", self.returns, LQR_PARTS))
        put(self, "delay", checks.integer("delay", self.delay, 0, limits.max_horizon))
        checks.word("method", self.method, LQR_METHODS)
        checks.flag("force", self.force)

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
        rows, image, code = limits.max_horizon, self.target_image, self.target_code
        if code is not None:
            code = checks.vector_or_table("target_code", code, rows, limits.max_code_size)
            object.__setattr__(self, "target_code", code)
        else:
            checks.image_or_images("target_image", image, rows, limits.max_image_values)

    def _check_weights(self, limits: Limits) -> None:
        put = object.__setattr__
        put(self, "q", check_weights("q", self.q, limits.max_code_size, definite=False))
        put(self, "r", check_weights("r", self.r, limits.max_control_size, definite=True))
        if isinstance(self.qf, str):
            checks.word("qf", self.qf, TERMINAL_WEIGHTS)
        elif self.qf is not None:
            put(self, "qf", check_weights("qf", self.qf, limits.max_code_size, definite=False))
        check_sizes(ErrorCode.bad_weights, q=self.q, qf=self.qf, target_code=self.target_code)
        bounds = {name: getattr(self, name) for name in _BOUNDS}
        check_sizes(ErrorCode.bad_bounds, r=self.r, **bounds)

    def _check_bounds(self, limits: Limits) -> None:
        for name in _BOUNDS:
            bound: object = getattr(self, name)
            if bound is not None:
                checked = checks.vector(name, bound, limits.max_control_size)
                object.__setattr__(self, name, checked)
        _check_order(self.u_min, self.u_max)
        _check_rates(self.du_min, self.du_max)

    def _check_known(self, limits: Limits) -> None:
        if (self.known_channels is None) != (self.known_controls is None):
            raise checks.fault(
                ErrorCode.bad_controls,
                "known_channels",
                "and known_controls do not come together",
                "both or neither",
            )
        if self.known_channels is None:
            return
        channels = checks.integers(
            "known_channels", self.known_channels, 0, limits.max_control_size - 1
        )
        controls = checks.table(
            "known_controls", self.known_controls, limits.max_horizon, limits.max_control_size
        )
        if len(set(channels)) != len(channels) or len(channels) != controls.shape[1]:
            raise checks.fault(
                ErrorCode.bad_controls,
                "known_channels",
                f"is {list(channels)}, and known_controls has {controls.shape[1]} columns",
                "every channel once, and one column for each",
            )
        object.__setattr__(self, "known_channels", channels)
        object.__setattr__(self, "known_controls", np.asarray(controls, np.float64))


@dataclass(frozen=True, eq=False)
class LqrReply:
    """Controls to the target and what the model expects of them; or why there are none.

    Attributes:
        trajectory: its name.
        epoch: the source's run.
        seq: the last frame that the service had folded.
        status: the solver's outcome, "solved" where the controls are optimal, "unfit" where there
            are none.
        cost: the objective, constant part included; 0 without controls.
        kkt_residual: largest violation of the optimality conditions, computed by the service.
        controls: (N, p) float64, in the control's unit: ``controls[i]`` acts between the frames
            start + i and start + i + 1. None where the model is not fit and was not forced.
        codes: (N, n) codes at the frames start + 1 + i, or None if not asked for.
        frames: (N, ...) predicted frames of the stream's own shape and dtype, or None.
        target_error: RMSE of the autoencoder's reconstruction of the target image, in the image's
            unit, the largest of a sequence's; 0 where the target was a code.
        start: number of the interval that ``controls[0]`` acts in, seq + the query's delay; seq
            where nobody says.
        fit: whether the model is fit for control.
        reasons: why it is not, for a person.
        warnings: what else a person should know, such as a target that cannot be held.
        modes: (m, 4) float64, the model's unstable modes, fastest growing first: real and imaginary
            part of the eigenvalue, how little must change for no control to reach it, and the
            control's gain on it in standard deviations. None where all are stable.
        scores: (p,) effect of each control channel in standard deviations.
        information: (p,) what the data say of that effect over what the prior says.
        residual: recent one-step errors over the usual ones.
        band: below which that counts as usual; 0 where nothing could be judged yet.
        probing: (T, p) an input that would let the model be learned; None beside controls.
    """

    trajectory: str
    epoch: str
    seq: int
    status: str
    cost: float
    kkt_residual: float
    controls: checks.Floats | None = None
    codes: NDArray[np.floating] | None = None
    frames: checks.Image | None = None
    target_error: float = 0.0
    start: int = _AS_SEQ
    fit: bool = True
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    modes: checks.Floats | None = None
    scores: checks.Floats | None = None
    information: checks.Floats | None = None
    residual: float = 0.0
    band: float = 0.0
    probing: checks.Floats | None = None
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        check_trajectory(self.trajectory, limits.max_name_length)
        checks.epoch("epoch", self.epoch)
        put(self, "seq", checks.sequence("seq", self.seq))
        checks.text("status", self.status, limits.max_name_length)
        put(self, "cost", checks.real("cost", self.cost))
        for name in ("kkt_residual", "target_error", "residual", "band"):
            put(self, name, checks.real(name, getattr(self, name), 0.0))
        start = self.seq if self.start == _AS_SEQ else self.start
        put(self, "start", checks.integer("start", start, self.seq, MAX_SEQUENCE))
        checks.flag("fit", self.fit)
        for name in ("reasons", "warnings"):
            put(self, name, checks.texts(name, getattr(self, name), MAX_TEXT_BYTES))
        self._check_controls(limits)
        self._check_numbers(limits)

    def _check_controls(self, limits: Limits) -> None:
        """Controls with a row a step, or a reason why there are none."""
        for name in ("controls", "probing"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, check_controls(name, value, limits))
        if self.controls is None and self.fit:
            raise checks.fault(
                ErrorCode.malformed, "controls", "are missing", "controls of a fit model"
            )
        if self.controls is not None:
            rows = self.controls.shape[0]
            check_rows({"codes": self.codes}, self.frames, limits, controls=rows)

    def _check_numbers(self, limits: Limits) -> None:
        put = object.__setattr__
        for name in ("scores", "information"):
            value = getattr(self, name)
            if value is not None:
                put(self, name, checks.vector(name, value, limits.max_control_size))
        if self.modes is not None:
            modes = checks.table("modes", self.modes, limits.max_horizon, _MODE_COLUMNS)
            if modes.shape[1] != _MODE_COLUMNS:
                expected = f"(modes, {_MODE_COLUMNS})"
                raise checks.fault(
                    ErrorCode.wrong_shape, "modes", f"has shape {modes.shape}", expected
                )
            put(self, "modes", np.asarray(modes, np.float64))


def check_controls(field: str, value: object, limits: Limits) -> checks.Floats:
    """Controls (steps, p) as float64, or ProtocolError."""
    controls = checks.table(field, value, limits.max_horizon, limits.max_control_size)
    return np.asarray(controls, np.float64)


def _check_order(low: checks.Floats | None, high: checks.Floats | None) -> None:
    """ProtocolError where both are given, of one size, and cross."""
    if low is None or high is None or low.shape != high.shape or (low <= high).all():
        return
    at = int(np.argmax(low > high))
    raise checks.fault(
        ErrorCode.bad_bounds,
        "u_min",
        f"is above u_max in component {at}: {low[at]} > {high[at]}",
        "u_min <= u_max in every component",
    )


def _check_rates(slowest: checks.Floats | None, fastest: checks.Floats | None) -> None:
    """ProtocolError where one of them does not let a control stay as it is."""
    for name, wrong in (
        ("du_min", slowest is not None and (slowest > 0.0).any()),
        ("du_max", fastest is not None and (fastest < 0.0).any()),
    ):
        if wrong:
            raise checks.fault(
                ErrorCode.bad_bounds,
                name,
                "does not let a control stay as it is",
                "du_min <= 0 <= du_max in every component",
            )
