"""What a source sends: frames and the controls between them."""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field

from koop_protocol import checks
from koop_protocol.keys import check_trajectory
from koop_protocol.limits import DEFAULT_LIMITS, Limits


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a trajectory.

    Attributes:
        trajectory: its name.
        epoch: the source's run, 16 lower-case hex digits.
        seq: number of the frame in its epoch, from 0.
        control_size: size p of the controls in this stream; 0 where the system is not actuated.
        image: (H, W) or (C, H, W), uint8 in 0..255 or float16 or float32.
        renderer: name of what drew the image; "" is a real camera.
        logged: whether the source's log had the frame before it was put, so that what is missed
            can be had on ``koop/replay/**``.
    """

    trajectory: str
    epoch: str
    seq: int
    control_size: int
    image: checks.Image
    renderer: str = ""
    logged: bool = False
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        _check_position(self, limits)
        put = object.__setattr__
        size = checks.integer("control_size", self.control_size, 0, limits.max_control_size)
        put(self, "control_size", size)
        checks.image("image", self.image, limits.max_image_values)
        checks.text("renderer", self.renderer, limits.max_name_length)
        checks.flag("logged", self.logged)


@dataclass(frozen=True, eq=False)
class Control:
    """The control that acted between frame ``seq`` and frame ``seq + 1``.

    Attributes:
        trajectory: its name.
        epoch: the source's run, 16 lower-case hex digits.
        seq: number of the frame that the control follows.
        u: (p,) float64, in the units of the system's actuators; finite.
    """

    trajectory: str
    epoch: str
    seq: int
    u: checks.Floats
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        _check_position(self, limits)
        object.__setattr__(self, "u", checks.vector("u", self.u, limits.max_control_size))


def _check_position(message: Frame | Control, limits: Limits) -> None:
    check_trajectory(message.trajectory, limits.max_name_length)
    checks.epoch("epoch", message.epoch)
    object.__setattr__(message, "seq", checks.sequence("seq", message.seq))
