"""The option groups of `koop-sim-client`: what each means, its default, and what makes sense."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from koop_clients.connection import DEFAULT_ENDPOINT
from koop_clients.flow.settings import MAX_ROTATION, REYNOLDS, FlowSettings

ANGLES = {"upright": 0.0, "hang": math.pi}
"""Targets by name [rad]."""

PICTURES = (".png", ".npy")
"""Endings of a target that is a picture."""

_DEFAULT_START = 1.0  # rad from the target


def unset(metavar: str, otherwise: str) -> object:
    """An option that stays None unless given."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {otherwise})")


OptionalRadians = Annotated[float | None, unset("RAD", "1 rad from the target")]
OptionalRange = Annotated[tuple[float, float] | None, unset("LOW HIGH", "--start for all")]
OptionalTime = Annotated[float | None, unset("S", "never")]
OptionalFile = Annotated[Path | None, unset("FILE", "none")]
OptionalValue = Annotated[float | None, unset("FLOAT", "the system's own")]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


@dataclass(frozen=True)
class DriveOptions:
    """Where the plant is to be brought, and by which means."""

    target: str = "upright"
    """Where to bring the pole: upright, hang, an angle [rad] (0 is upright), or a picture of it
    (.png or .npy, grey, 64 x 64). A cylinder's wake is brought to the steady flow."""
    learn: float = 10.0
    """Excitation before the drive begins [s]; 24 of the cylinder."""
    start: OptionalRadians = None
    """Angle near which the drive begins [rad]."""
    starts: OptionalRange = None
    """Draw each plant's start from this range instead [rad]."""
    horizon: int = 10
    """Frames that a plan looks ahead; 16 of the cylinder."""
    q: float = 1.0
    """Weight on the distance of the code from the target's."""
    r: float = 1e-3
    """Weight on the torque [1/(N m)^2]; 0.01 on the cylinder's rotation [(D/U)^2]."""
    qf: str = "none"
    """Weight of a plan's last step in q's place: none, riccati, or a number."""
    torque_bound: float = 20.0
    """Largest torque that may be used [N m]."""
    frozen: Flag = False
    """The service's model stays as it is when the drive begins."""
    force: Flag = False
    """Drive even where the service says that its model is not fit for control."""

    def __post_init__(self) -> None:
        require(self.horizon >= 1, "horizon", self.horizon, "at least 1")
        require(positive(self.r), "r", self.r, "above 0")
        require(positive(self.torque_bound), "torque-bound", self.torque_bound, "above 0")
        require(not_negative(self.learn), "learn", self.learn, "0 or more")
        require(not_negative(self.q), "q", self.q, "0 or more")
        require(self.qf in ("none", "riccati") or not_negative(number(self.qf)), "qf", self.qf,
                "none, riccati, or a number of 0 or more")  # fmt: skip
        expected = "upright, hang, an angle in rad such as 0.5, or a .png or .npy file"
        known = self.is_picture or math.isfinite(self.angle)
        require(known, "target", self.target, expected)
        self._check_starts()

    def _check_starts(self) -> None:
        if self.start is not None:
            require(math.isfinite(self.start), "start", self.start, "an angle in rad")
        if self.starts is not None:
            low, high = self.starts
            sound = math.isfinite(low) and math.isfinite(high) and low <= high
            require(sound, "starts", f"{low} {high}", "two angles in rad, the lower one first")
            if self.start is not None:
                raise ValueError("--start and --starts exclude each other; give one of them")

    @property
    def is_picture(self) -> bool:
        """Whether the target is told by a picture."""
        return self.target.lower().endswith(PICTURES)

    @property
    def angle(self) -> float:
        """Angle of a target that is told by one [rad]; NaN otherwise."""
        return ANGLES[self.target] if self.target in ANGLES else number(self.target)

    def start_angle(self, target: float, share: float) -> float:
        """Angle at which the drive of a plant begins [rad].

        `target` is the target's [rad]; `share` in [0, 1) says where in `starts`.
        """
        if self.starts is not None:
            return self.starts[0] + share * (self.starts[1] - self.starts[0])
        return target + _DEFAULT_START if self.start is None else self.start


@dataclass(frozen=True)
class TroubleOptions:
    """What goes wrong during the drive; times count from its beginning."""

    kick: float = 0.0
    """An angular impulse on the pole's joint [N m s]."""
    kick_at: float = 1.0
    """When it comes [s]."""
    noise: float = 0.0
    """Standard deviation of a torque that the service does not see, drawn at each frame [N m]."""
    change_mass_at: OptionalTime = None
    """When the mass at the (first) pole's tip changes [s]."""
    change_mass: float = 1.5
    """By which factor."""
    delay: float = 0.0
    """How much later a frame reaches the service than it was taken, a slow camera [s]."""

    def __post_init__(self) -> None:
        require(math.isfinite(self.kick), "kick", self.kick, "a number of N m s")
        require(not_negative(self.kick_at), "kick-at", self.kick_at, "0 or more")
        require(not_negative(self.noise), "noise", self.noise, "0 or more")
        at = self.change_mass_at
        require(at is None or not_negative(at), "change-mass-at", at, "0 or more")
        require(positive(self.change_mass), "change-mass", self.change_mass, "above 0")
        require(0 <= self.delay <= 1, "delay", self.delay, "0 to 1 s")


@dataclass(frozen=True)
class PredictionOptions:
    """Predictions asked for while the service learns."""

    ahead: int = 20
    """Frames that predictions look ahead; 10 of the cylinder."""
    ask_every: float = 0.1
    """Simulated time between two predictions [s]; 1.5 of the cylinder."""

    def __post_init__(self) -> None:
        require(self.ahead >= 1, "ahead", self.ahead, "at least 1")
        require(positive(self.ask_every), "ask-every", self.ask_every, "above 0")


@dataclass(frozen=True)
class ServiceOptions:
    """Where the service is."""

    connect: Annotated[str | None, unset("ENDPOINT", DEFAULT_ENDPOINT)] = None
    """Zenoh endpoint."""
    zenoh_config: OptionalFile = None
    """A raw Zenoh configuration (JSON5), for instance with certificates."""
    wait: float = 10.0
    """How long to wait for a service that is still starting [s]."""
    log: OptionalFile = None
    """Keep in this file what was put until the service has it on disk, so that nothing is lost when
    the service is killed, or this program."""

    def __post_init__(self) -> None:
        require(not_negative(self.wait), "wait", self.wait, "0 or more")

    @property
    def endpoint(self) -> str:
        """Where it is looked for, in words."""
        return self.connect or (str(self.zenoh_config) if self.zenoh_config else DEFAULT_ENDPOINT)


@dataclass(frozen=True)
class OutputOptions:
    """What is left behind; progress goes to standard error, a summary to standard output."""

    strip: OptionalFile = None
    """Save a picture: what happened, over what was predicted."""
    record: OptionalFile = None
    """Save some predictions of the first plant, and the drives (NumPy .npz)."""
    json: Flag = False
    """Print the summary as one line of JSON."""


@dataclass(frozen=True)
class FlowOptions:
    """The flow past the cylinder."""

    reynolds: Annotated[float | None, unset("FLOAT", f"{REYNOLDS:g}")] = None
    """Reynolds number of the flow past the cylinder."""
    rotation_bound: float = 0.42
    """Fastest rotation that a drive may use [U/D]; 0.42 is 0.1 in the units of Morton et al."""

    def __post_init__(self) -> None:
        bound = self.rotation_bound
        require(0 < bound <= MAX_ROTATION, "rotation-bound", bound,
                f"a number above 0, up to {MAX_ROTATION}")  # fmt: skip

    @property
    def settings(self) -> FlowSettings:
        """Of the simulator."""
        return FlowSettings(REYNOLDS if self.reynolds is None else self.reynolds)


@dataclass(frozen=True)
class PhysicalOptions:
    """The plant's physical parameters, of those that it has."""

    mass: OptionalValue = None
    """Mass at the (first) pole's tip [kg]."""
    length: OptionalValue = None
    """Length of the (first) pole [m]."""
    mass_2: OptionalValue = None
    """Mass at the second pole's tip [kg]."""
    length_2: OptionalValue = None
    """Length of the second pole [m]."""
    cart_mass: OptionalValue = None
    """Mass of the cart [kg]."""
    damping: OptionalValue = None
    """Viscous friction in every joint [N m s/rad, N s/m]."""

    @property
    def given(self) -> dict[str, float]:
        """Those that were given."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def require(condition: bool, option: str, value: object, expected: str) -> None:
    """Raise ValueError for the option unless `condition` holds."""
    if not condition:
        raise ValueError(f"--{option} is {value}; expected {expected}")


def number(text: str) -> float:
    """The number that a text stands for; NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def positive(value: float) -> bool:
    """Whether it is finite and above 0."""
    return math.isfinite(value) and value > 0


def not_negative(value: float) -> bool:
    """Whether it is finite and at least 0."""
    return math.isfinite(value) and value >= 0
