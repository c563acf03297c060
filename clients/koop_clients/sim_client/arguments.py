"""The command line of `koop-sim-client` as a value that makes sense."""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Literal

import tyro

from koop_clients.flow.settings import FRAME_INTERVAL as FLOW_INTERVAL
from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.sim_client.options import (
    DriveOptions,
    Flag,
    FlowOptions,
    OutputOptions,
    PhysicalOptions,
    PredictionOptions,
    ServiceOptions,
    TroubleOptions,
    not_negative,
    number,
    require,
)

HORIZONS = (1, 2, 5, 10, 20)
"""Frames ahead at which prediction errors are told."""

_RATES = {"realtime": 1.0, "max": math.inf}
_METHODS = {"lqr": "gain", "mpc": "qp", "plan": "qp"}


@dataclass(frozen=True)
class Arguments:
    """Simulate plants, stream their cameras to a koop service, and watch the service learn.

    It asks for predictions while it streams and tells how far they are from what happens then.
    With `--drive mpc` or `lqr` it lets the service's commands bring the pole to a target, or calm
    the cylinder's wake. Ctrl-C stops it with a summary.
    """

    system: Literal["pendulum", "double-pendulum", "cartpole", "cylinder"]
    """Which plant. It streams as SYSTEM/0 (and SYSTEM/1, ...), or SYSTEM-actuated/0. The cylinder
    stands in a flow; its frames are not grey pictures but density, momenta and energy."""
    actuated: Flag = False
    """The pole has a motor, which excites it; its torque is streamed as the control. The cylinder's
    turns it by a random schedule; the rotation is streamed."""
    drive: Literal["none", "excite", "lqr", "mpc", "plan", "pd", "state-lqr", "feedback"] = "none"
    """excite tracks random references. The others do so for a while, then bring the pole to the
    target, or the wake to the steady flow: lqr obeys the service's feedback gain, mpc its receding
    horizon, plan follows one plan of it to the end, blindly. For comparison pd and state-lqr know
    the pole's true state, and feedback the velocity behind the cylinder, and ask nobody. All of
    them imply --actuated."""
    trajectories: int = 1
    """How many plants to stream at once."""
    first: int = 0
    """Number of the first plant, for several clients at one service."""
    duration: float = 30.0
    """Simulated time [s]; 0 goes on until Ctrl-C."""
    rate: str = "realtime"
    """realtime, max (simulated time waits for the service), or a factor such as 4 (simulated over
    real time)."""
    seed: int = 0
    """Seed of starts and torques; the same seed gives each plant, by number, the same."""
    driving: DriveOptions = field(default_factory=DriveOptions)
    trouble: TroubleOptions = field(default_factory=TroubleOptions)
    prediction: PredictionOptions = field(default_factory=PredictionOptions)
    service: ServiceOptions = field(default_factory=ServiceOptions)
    output: OutputOptions = field(default_factory=OutputOptions)
    physical: PhysicalOptions = field(default_factory=PhysicalOptions)
    flow: FlowOptions = field(default_factory=FlowOptions)

    def __post_init__(self) -> None:
        require(self.trajectories >= 1, "trajectories", self.trajectories, "at least 1")
        require(self.first >= 0, "first", self.first, "0 or more")
        require(self.seed >= 0, "seed", self.seed, "0 or more")
        require(not_negative(self.duration), "duration", self.duration, "0 or more")
        expected = "realtime, max, or a factor above 0 such as 4"
        require(self.speed > 0, "rate", self.rate, expected)
        self._check_kind()
        if self.drives and self.duration and self.duration <= self.driving.learn:
            raise ValueError(
                f"--duration is {self.duration:g} s, no longer than --learn "
                f"({self.driving.learn:g} s); nothing is left for {self.drive} to drive"
            )

    def _check_kind(self) -> None:
        """Nothing may be asked of one kind of system that only the other knows."""
        if self.is_flow:
            self._check_flow()
            return
        default = FlowOptions()
        for name, value in asdict(self.flow).items():
            require(value == getattr(default, name), name.replace("_", "-"), value,
                    "nothing: only the cylinder stands in a flow")  # fmt: skip
        require(self.drive != "feedback", "drive", self.drive, "another one: it is the cylinder's")

    def _check_flow(self) -> None:
        known = self.drive not in ("plan", "pd", "state-lqr")
        require(known, "drive", self.drive, "none, excite, mpc, lqr or feedback for the cylinder")
        require(self.driving.target == "upright", "target", self.driving.target,
                "nothing: the cylinder's wake is brought to the steady flow")  # fmt: skip
        for name, value in {**self.physical.given, "strip": self.output.strip}.items():
            option = name.replace("_", "-")
            require(value is None, option, value, "nothing: it is not for the cylinder")
        if self.output.record is not None and not self.drives:
            raise ValueError("--record of the cylinder keeps a drive; add --drive mpc")

    @property
    def is_flow(self) -> bool:
        """Whether it is the flow past the cylinder."""
        return self.system == "cylinder"

    @property
    def interval(self) -> float:
        """From one frame to the next [s]."""
        return FLOW_INTERVAL if self.is_flow else FRAME_INTERVAL

    @property
    def is_actuated(self) -> bool:
        """Whether torques act and are streamed."""
        return self.actuated or self.drive != "none"

    @property
    def drives(self) -> bool:
        """Whether the plant is brought to a target."""
        return self.drive not in ("none", "excite")

    @property
    def method(self) -> str | None:
        """How the service is asked to drive; None where it is not."""
        return _METHODS.get(self.drive)

    @property
    def takeover(self) -> float:
        """Number of the first frame of the drive; infinite without one."""
        return round(self.driving.learn / self.interval) if self.drives else math.inf

    @property
    def frames(self) -> float:
        """How many frames to stream; infinite until Ctrl-C."""
        return round(self.duration / self.interval) or math.inf

    def trajectory(self, index: int) -> str:
        """The name that plant `index` streams under; the service picks its model by it."""
        kind = f"{self.system}-actuated" if self.is_actuated else self.system
        return f"{kind}/{self.first + index}"

    @property
    def speed(self) -> float:
        """Simulated over real time; infinite for "max"."""
        return _RATES[self.rate] if self.rate in _RATES else number(self.rate)

    @property
    def horizons(self) -> tuple[int, ...]:
        """The horizons that errors are told at [frames]."""
        ahead = self.prediction.ahead
        return tuple(h for h in HORIZONS if h <= ahead) or (ahead,)


def parse_arguments(arguments: list[str] | None = None) -> Arguments:
    """Read the command line; exits for an unknown option, raises ValueError for a bad value."""
    parse = partial(
        tyro.cli,
        Arguments,
        prog="koop-sim-client",
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes,),
    )
    return parse(default=_FLOW) if _asks_for_the_cylinder(arguments) else parse()


_FLOW = Arguments(
    "cylinder",
    driving=DriveOptions(learn=24.0, horizon=16, r=1e-2),
    prediction=PredictionOptions(ahead=10, ask_every=1.5),
)


def _asks_for_the_cylinder(arguments: list[str] | None) -> bool:
    """The cylinder's defaults are other ones, so it must be known before all else is read."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--system")
    return parser.parse_known_args(arguments)[0].system == "cylinder"
