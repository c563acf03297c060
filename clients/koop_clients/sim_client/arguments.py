"""The options of `koop-sim-client`: what they mean, their defaults, and which values make sense."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from koop_clients.connection import DEFAULT_ENDPOINT

HORIZONS = (1, 2, 5, 10, 20)
"""Frames ahead at which prediction errors are told."""

_TARGETS = {"upright": 0.0, "hang": math.pi}
_RATES = {"realtime": 1.0, "max": math.inf}
_DEFAULT_START = 1.0  # rad from the target


def _unset(metavar: str, otherwise: str) -> object:
    """An option that stays None unless given."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {otherwise})")


OptionalRadians = Annotated[float | None, _unset("RAD", "1 rad from the target")]
OptionalFile = Annotated[Path | None, _unset("FILE", "none")]
OptionalValue = Annotated[float | None, _unset("FLOAT", "the system's own")]


@dataclass(frozen=True)
class DriveOptions:
    """What the service's controls are asked for."""

    target: str = "upright"
    """Where to bring the pole: upright, hang, or an angle [rad], 0 being upright."""
    learn: float = 10.0
    """Excitation before lqr takes over [s]."""
    start: OptionalRadians = None
    """Angle near which lqr takes over [rad]."""
    horizon: int = 10
    """Frames that a plan looks ahead."""
    q: float = 1.0
    """Weight on the distance of the code from the target's."""
    r: float = 1e-3
    """Weight on the torque [1/(N m)^2]."""
    torque_bound: float = 20.0
    """Largest torque that may be used [N m]."""

    def __post_init__(self) -> None:
        require(self.horizon >= 1, "horizon", self.horizon, "at least 1")
        require(_positive(self.r), "r", self.r, "above 0")
        require(_positive(self.torque_bound), "torque-bound", self.torque_bound, "above 0")
        require(_not_negative(self.learn), "learn", self.learn, "0 or more")
        require(_not_negative(self.q), "q", self.q, "0 or more")
        expected = "upright, hang, or an angle in rad such as 0.5"
        require(math.isfinite(self.target_angle), "target", self.target, expected)

    @property
    def target_angle(self) -> float:
        """Angle of the target [rad]."""
        return _TARGETS[self.target] if self.target in _TARGETS else _number(self.target)

    @property
    def start_angle(self) -> float:
        """Angle near which lqr takes over [rad]."""
        return self.target_angle + _DEFAULT_START if self.start is None else self.start


@dataclass(frozen=True)
class PredictionOptions:
    """Predictions asked for while the service learns."""

    ahead: int = 20
    """Frames that predictions look ahead."""
    ask_every: float = 0.1
    """Simulated time between two predictions [s]."""

    def __post_init__(self) -> None:
        require(self.ahead >= 1, "ahead", self.ahead, "at least 1")
        require(_positive(self.ask_every), "ask-every", self.ask_every, "above 0")


@dataclass(frozen=True)
class ServiceOptions:
    """Where the service is."""

    connect: Annotated[str | None, _unset("ENDPOINT", DEFAULT_ENDPOINT)] = None
    """Zenoh endpoint."""
    zenoh_config: OptionalFile = None
    """A raw Zenoh configuration (JSON5), for instance with certificates."""
    wait: float = 10.0
    """How long to wait for a service that is still starting [s]."""

    def __post_init__(self) -> None:
        require(_not_negative(self.wait), "wait", self.wait, "0 or more")

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
    """Save some predictions and the drive of the first plant (NumPy .npz)."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the summary as one line of JSON."""


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


@dataclass(frozen=True)
class Arguments:
    """Simulate a plant, stream its camera to a koop service, and watch the service learn.

    It asks for predictions while it streams and tells how far they are from what happens then.
    With `--drive lqr` it lets the service's controls bring the pole to a target. Ctrl-C stops it
    with a summary.
    """

    system: Literal["pendulum", "double-pendulum", "cartpole"]
    """Which plant. It streams as SYSTEM/0 (and SYSTEM/1, ...), or SYSTEM-actuated/0."""
    actuated: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """The pole has a motor, which excites it; its torque is streamed as the control."""
    drive: Literal["none", "excite", "lqr"] = "none"
    """excite tracks random references; lqr does so for a while, then obeys the service. Both imply
    --actuated."""
    trajectories: int = 1
    """How many plants to stream at once."""
    first: int = 0
    """Number of the first plant, for several clients at one service."""
    duration: float = 30.0
    """Simulated time [s]; 0 goes on until Ctrl-C."""
    rate: str = "realtime"
    """realtime, max, or a factor such as 4 (simulated over real time)."""
    seed: int = 0
    """Seed of initial states and torques; the same seed gives the same frames."""
    lqr: DriveOptions = field(default_factory=DriveOptions)
    prediction: PredictionOptions = field(default_factory=PredictionOptions)
    service: ServiceOptions = field(default_factory=ServiceOptions)
    output: OutputOptions = field(default_factory=OutputOptions)
    physical: PhysicalOptions = field(default_factory=PhysicalOptions)

    def __post_init__(self) -> None:
        require(self.trajectories >= 1, "trajectories", self.trajectories, "at least 1")
        require(self.first >= 0, "first", self.first, "0 or more")
        require(self.seed >= 0, "seed", self.seed, "0 or more")
        require(_not_negative(self.duration), "duration", self.duration, "0 or more")
        expected = "realtime, max, or a factor above 0 such as 4"
        require(self.speed > 0, "rate", self.rate, expected)
        if self.drive == "lqr":
            self._check_drive()

    def _check_drive(self) -> None:
        if self.trajectories != 1:
            raise ValueError("--drive lqr drives one plant; leave --trajectories at 1")
        if self.duration and self.duration <= self.lqr.learn:
            raise ValueError(
                f"--duration is {self.duration:g} s, no longer than --learn "
                f"({self.lqr.learn:g} s); nothing is left for lqr to drive"
            )

    @property
    def is_actuated(self) -> bool:
        """Whether torques act and are streamed."""
        return self.actuated or self.drive != "none"

    def trajectory(self, index: int) -> str:
        """The name that plant `index` streams under; the service picks its model by it."""
        kind = f"{self.system}-actuated" if self.is_actuated else self.system
        return f"{kind}/{self.first + index}"

    @property
    def speed(self) -> float:
        """Simulated over real time; infinite for "max"."""
        return _RATES[self.rate] if self.rate in _RATES else _number(self.rate)

    @property
    def horizons(self) -> tuple[int, ...]:
        """The horizons that errors are told at [frames]."""
        ahead = self.prediction.ahead
        return tuple(h for h in HORIZONS if h <= ahead) or (ahead,)


def require(condition: bool, option: str, value: object, expected: str) -> None:
    """Raise ValueError for the option unless `condition` holds."""
    if not condition:
        raise ValueError(f"--{option} is {value}; expected {expected}")


def parse_arguments(arguments: list[str] | None = None) -> Arguments:
    """Read the command line; exits for an unknown option, raises ValueError for a bad value."""
    return tyro.cli(
        Arguments,
        prog="koop-sim-client",
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes,),
    )


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _positive(value: float) -> bool:
    return math.isfinite(value) and value > 0


def _not_negative(value: float) -> bool:
    return math.isfinite(value) and value >= 0
