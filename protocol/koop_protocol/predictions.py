"""Asking for a prediction, and the answer."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field

import numpy as np
from numpy.typing import NDArray

from koop_protocol import checks
from koop_protocol.errors import ErrorCode
from koop_protocol.keys import check_trajectory
from koop_protocol.limits import DEFAULT_LIMITS, Limits

DEFAULT_HORIZON = 20
PREDICTION_PARTS = frozenset({"codes", "frames", "std"})
_CODES_ONLY = frozenset({"codes"})


@dataclass(frozen=True, eq=False)
class PredictQuery:
    """Predict ``horizon`` frames ahead of the last one that the service has folded.

    Attributes:
        horizon: number of frames H.
        controls: (H, p) float64, row i acts before predicted frame i arrives; None: the service
            holds the last control.
        returns: what to send back, of "codes", "frames" and "std".
    """

    horizon: int = DEFAULT_HORIZON
    controls: checks.Floats | None = None
    returns: frozenset[str] = _CODES_ONLY
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        put(self, "horizon", check_horizon(self.horizon, limits))
        put(self, "returns", checks.choices("returns", self.returns, PREDICTION_PARTS))
        if not self.returns:
            raise checks.fault(
                ErrorCode.malformed, "returns", "is empty", "at least one of codes, frames, std"
            )
        if self.controls is not None:
            put(self, "controls", _check_controls(self.controls, self.horizon, limits))


@dataclass(frozen=True, eq=False)
class PredictReply:
    """A prediction; row i is frame ``seq + 1 + i`` of the epoch.

    Attributes:
        trajectory: its name.
        epoch: the source's run that the prediction continues.
        seq: the last frame that the service had folded.
        codes: (H, n) float32 or float64, or None if not asked for.
        frames: (H, ...) images of the stream's own shape and dtype, or None.
        std: (H, n) standard deviation of the codes, in the codes' unit, or None.
    """

    trajectory: str
    epoch: str
    seq: int
    codes: NDArray[np.floating] | None = None
    frames: checks.Image | None = None
    std: NDArray[np.floating] | None = None
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        check_trajectory(self.trajectory, limits.max_name_length)
        checks.epoch("epoch", self.epoch)
        object.__setattr__(self, "seq", checks.sequence("seq", self.seq))
        check_rows({"codes": self.codes, "std": self.std}, self.frames, limits)
        if self.codes is None and self.frames is None and self.std is None:
            raise checks.fault(
                ErrorCode.malformed, "reply", "is empty", "codes, frames or std in it"
            )
        if self.codes is not None and self.std is not None and self.codes.shape != self.std.shape:
            raise checks.fault(
                ErrorCode.wrong_shape,
                "std",
                f"has shape {self.std.shape}",
                f"that of the codes, {self.codes.shape}",
            )


def predict_query_from_parameters(
    parameters: Mapping[str, str], limits: Limits = DEFAULT_LIMITS
) -> PredictQuery:
    """The query that a Zenoh selector's parameters ask for, as in ``?horizon=20;return=codes,std``.

    Only read where the query has no payload. A parameter that begins with "_" is Zenoh's own and
    passed over; any other unknown one is an error, since a misspelt one would go unnoticed.

    Raises:
        ProtocolError: bad_horizon or malformed.
    """
    for name in parameters:
        if name not in ("horizon", "return") and not name.startswith("_"):
            raise checks.fault(
                ErrorCode.malformed,
                "selector",
                f"has an unknown parameter {name[:60]!r}",
                "horizon or return, separated by ';'",
                "write for instance '?horizon=20;return=codes,frames'",
            )
    return PredictQuery(
        _parse_horizon(parameters.get("horizon", str(DEFAULT_HORIZON))),
        returns=frozenset(parameters.get("return", "codes").split(",")),
        limits=limits,
    )


def _parse_horizon(digits: str) -> int:
    if re.fullmatch(r"-?[0-9]{1,18}", digits, re.ASCII) is None:
        raise checks.fault(
            ErrorCode.bad_horizon, "horizon", f"is {digits[:60]!r}", "a whole number, as in 20"
        )
    return int(digits)


def check_horizon(value: object, limits: Limits) -> int:
    """A horizon in [1, max_horizon], else ProtocolError (wrong_type, bad_horizon)."""
    horizon = checks.integer("horizon", value, -(2**63), 2**64)
    if not 1 <= horizon <= limits.max_horizon:
        raise checks.fault(
            ErrorCode.bad_horizon, "horizon", f"is {horizon}", f"1 to {limits.max_horizon} steps"
        )
    return horizon


def check_rows(
    tables: Mapping[str, NDArray[np.floating] | None],
    frames: checks.Image | None,
    limits: Limits,
    **known_rows: int,
) -> None:
    """Check the parts of a reply that have one row a step: all have equally many.

    Args:
        tables: (rows, n) arrays over the code, by name.
        frames: (rows, ...) images.
        limits: what a receiver takes.
        known_rows: rows of further parts, already checked otherwise.
    """
    rows = dict(known_rows)
    for name, array in tables.items():
        if array is not None:
            checks.table(name, array, limits.max_horizon, limits.max_code_size)
            rows[name] = array.shape[0]
    if frames is not None:
        checks.images("frames", frames, limits.max_horizon, limits.max_image_values)
        rows["frames"] = frames.shape[0]
    if len(set(rows.values())) > 1:
        raise checks.fault(
            ErrorCode.wrong_shape, "reply", f"has the rows {rows}", "one row a step in every part"
        )


def _check_controls(value: object, horizon: int, limits: Limits) -> checks.Floats:
    controls = checks.table("controls", value, limits.max_horizon, limits.max_control_size)
    if controls.shape[0] != horizon:
        raise checks.fault(
            ErrorCode.bad_controls,
            "controls",
            f"has {controls.shape[0]} rows",
            f"one row a step, {horizon} for this horizon",
        )
    return np.asarray(controls, np.float64)
