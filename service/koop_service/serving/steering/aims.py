"""What a control query asks of one trajectory: checked against it, pictures as codes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koop_protocol import ErrorCode, LqrQuery, ProtocolError
from koop_service.serving.trajectories.trajectory import Trajectory, check_size, check_values

Array = NDArray[np.float64]

MAX_PLANNED = 400
"""Most numbers in a control sequence (N*p): the QP's time grows with its cube, to about 50 ms."""
MAX_COMMANDED = 100
"""The same in a task, which plans at every frame."""
_UNLIKE = 3.0
"""Times its usual error that the encoder may draw a target picture with."""


@dataclass(frozen=True, eq=False)
class Aim:
    """A query that fits its trajectory.

    codes: (K, n) targets, row i for step i + 1, of which the last stays.
    error: RMSE of the target pictures' reconstruction, the largest, in their unit; 0 for codes.
    doubt: why the codes of the target pictures mean little; "" where nothing says so.
    """

    query: LqrQuery
    codes: Array
    error: float = 0.0
    doubt: str = ""

    @property
    def bounds(self) -> tuple[Array | None, Array | None, Array | None, Array | None]:
        """u_min, u_max, du_min, du_max, as the functions of `koop_service.control` take them."""
        return self.query.u_min, self.query.u_max, self.query.du_min, self.query.du_max

    def targets(self, elapsed: int) -> Array:
        """The targets as they stand `elapsed` frames after the first."""
        return _later(self.codes, elapsed)

    def known(self, elapsed: int) -> dict[int, Array]:
        """The given channels' future, likewise."""
        channels, controls = self.query.known_channels, self.query.known_controls
        if channels is None or controls is None:
            return {}
        return dict(zip(channels, _later(controls, elapsed).T, strict=True))


def aim_of(trajectory: Trajectory, query: LqrQuery, most: int = MAX_PLANNED) -> Aim:
    """The query in the terms of this trajectory's model; ProtocolError where it does not fit.

    most: numbers that its control sequence may have.
    """
    _check_horizon(trajectory, query, most)
    _check_sizes(trajectory, query)
    _check_known(trajectory, query)
    if query.target_code is not None:
        return Aim(query, np.atleast_2d(query.target_code))
    pictures = _pictures(trajectory, np.asarray(query.target_image))
    codes = trajectory.codec.encode(pictures)
    error = _worst_error(pictures, trajectory.codec.decode(codes, pictures.dtype))
    return Aim(query, codes, error, _why_unlike(trajectory, error, pictures.dtype))


def _later(rows: Array, elapsed: int) -> Array:
    return rows[min(elapsed, len(rows) - 1) :]


def _check_horizon(trajectory: Trajectory, query: LqrQuery, most: int) -> None:
    p = trajectory.settings.control_size
    if p == 0:
        raise ProtocolError(
            ErrorCode.bad_controls,
            f"the trajectory {trajectory.name!r} is not actuated: its frames say control_size 0",
            "an actuated one",
            "stream with controls (koop-sim-client --actuated)",
        )
    if query.horizon * p > most:
        raise ProtocolError(
            ErrorCode.bad_horizon,
            f"horizon is {query.horizon}",
            f"at most {most // p} steps with {p} controls",
            "plan less far ahead, and again at later frames",
            {"field": "horizon", "limit": most // p},
        )


def _check_sizes(trajectory: Trajectory, query: LqrQuery) -> None:
    n, p = trajectory.settings.code_size, trajectory.settings.control_size
    for name, what, size, code in (
        ("target_code", "code", n, ErrorCode.bad_target),
        ("q", "code", n, ErrorCode.bad_weights),
        ("qf", "code", n, ErrorCode.bad_weights),
        ("r", "control", p, ErrorCode.bad_weights),
        ("u_min", "control", p, ErrorCode.bad_bounds),
        ("u_max", "control", p, ErrorCode.bad_bounds),
        ("du_min", "control", p, ErrorCode.bad_bounds),
        ("du_max", "control", p, ErrorCode.bad_bounds),
    ):
        value = getattr(query, name)
        if isinstance(value, np.ndarray) and value.shape[-1] != size:
            raise ProtocolError(
                code,
                f"{name} has size {value.shape[-1]}",
                f"{size}, the size of a {what} of {trajectory.name!r}",
                details={"field": name, "size": size},
            )
        if value is not None and not isinstance(value, str):
            check_size(value, code, name)


def _check_known(trajectory: Trajectory, query: LqrQuery) -> None:
    p, channels = trajectory.settings.control_size, query.known_channels or ()
    if channels and query.method == "gain":
        raise ProtocolError(
            ErrorCode.bad_controls,
            "the method 'gain' looks at no future of known channels",
            "the method 'qp', or no known_channels",
            details={"field": "known_channels"},
        )
    if len(channels) >= p or any(channel >= p for channel in channels):
        raise ProtocolError(
            ErrorCode.bad_controls,
            f"known_channels is {list(channels)}",
            f"channels from 0 to {p - 1} of {trajectory.name!r}, and one left to decide",
            details={"field": "known_channels", "control_size": p},
        )
    if query.known_controls is not None:
        check_size(query.known_controls, ErrorCode.bad_controls, "known_controls")


def _pictures(trajectory: Trajectory, image: NDArray[np.generic]) -> NDArray[np.generic]:
    """The target as a batch of frames (K, H, W) or (K, C, H, W) that the encoder takes."""
    shape = tuple(trajectory.codec.image_shape)
    if image.shape != shape and image.shape[1:] != shape:
        raise ProtocolError(
            ErrorCode.bad_target,
            f"target_image has shape {image.shape}",
            f"{shape}, as the model {trajectory.entry.name!r} takes, or several of them",
            details={"field": "target_image"},
        )
    check_values(image, trajectory.codec, ErrorCode.bad_target, "target_image")
    return image.reshape(-1, *shape)


def _worst_error(pictures: NDArray[np.generic], shown: NDArray[np.generic]) -> float:
    difference = shown.astype(np.float64) - pictures.astype(np.float64)
    return float(np.sqrt(np.mean(difference**2, axis=tuple(range(1, pictures.ndim)))).max())


def _why_unlike(trajectory: Trajectory, error: float, dtype: np.dtype) -> str:
    """A picture unlike those the model was trained on has a code without a meaning."""
    usual = trajectory.entry.card.figures.get("reconstruction")
    if not isinstance(usual, float | int):
        return ""
    usual *= 255.0 if dtype == np.uint8 else 1.0
    if error <= _UNLIKE * usual:
        return ""
    return (
        f"the target picture is unlike those that the model {trajectory.entry.name!r} knows: it"
        f" draws it with an error of {error:.3g} where {usual:.3g} is usual; expected at most"
        f" {_UNLIKE * usual:.3g}: send a picture of this system by this camera"
    )
