"""The runs that are judged: every method on every start, a change of mass, and plans followed
blindly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from koop_service.evaluation.control.methods import METHODS, Method
from koop_service.evaluation.control.plants import Plant
from koop_service.evaluation.control.servers import koop_serve, learned_b
from koop_service.evaluation.control.trials import Array, Protocol, Trials, run

CHANGE_AT, CHANGE_FACTOR = 3.0, 1.5
"""When the mass at the pole's tip changes, after takeover [s], and by which factor."""
CHANGE_TARGET = 0.5
"""Where the pole is held then [rad]: upright, no torque is needed, and none for another mass."""
CHANGE_STARTS, CHANGE_BETWEEN = 20, (-0.5, 0.5)
"""How many starts, and where [rad]."""
RECOVERY = 2.0
"""Time that the online model has to recover [s]."""
SHOWN = 1.0
"""Start of the drives that are shown in pictures [rad]."""
_BLIND = ("--drive", "plan")


@dataclass(frozen=True, eq=False)
class Change:
    """One plant whose mass changes; runs "online" and "frozen"."""

    plant: Plant
    at: float
    factor: float
    runs: Mapping[str, Trials]

    @property
    def title(self) -> str:
        return (
            f"{self.plant.system.title} held at {CHANGE_TARGET:g} rad, mass times {self.factor:g}"
        )

    def distance(self, method: str, after: float, dt: float) -> float:
        """Median distance from the target over half a second, `after` seconds after the change."""
        first = round((self.at + after) / dt)
        angles = self.runs[method].angles[:, first : first + round(0.5 / dt)]
        return float(np.nanmedian(np.abs(angles)))

    def before(self, method: str, dt: float) -> float:
        """The same in the half second before it."""
        return self.distance(method, -0.5, dt)


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """Plans that were followed to their end without a further look.

    arrival (N,): distance from the target at the plan's end [rad]. Of one start: planned and
    achieved pictures (steps, H, W), angles (steps + 1,) from the target, torques (steps,).
    """

    arrival: Array
    planned: NDArray[np.uint8]
    achieved: NDArray[np.uint8]
    angles: Array
    torques: Array


def server(method: Method, plant: Plant, weights: Path) -> AbstractContextManager[str]:
    """Who the client of this method streams to; its endpoint."""
    return (koop_serve if method.server == "service" else learned_b)(plant, weights)


def compare(
    plant: Plant, weights: Path, protocol: Protocol, tell: Callable[[str], None]
) -> dict[str, Trials]:
    """Every method from the same starts."""
    found = {}
    for method in METHODS.values():
        rate = protocol if method.timed else replace(protocol, rate="max")
        with server(method, plant, weights) as endpoint:
            trials = run(plant, method.drive, endpoint, rate)
        found[method.name] = trials
        tell(f"{plant.name}: {method.title}: {trials.success.sum()} of {len(trials.success)}")
    return found


def change_mass(plant: Plant, weights: Path, protocol: Protocol) -> Change:
    """Hold the pole off the upright, and change its mass: the online model against the frozen.

    By the gain: eq. 13 pays for the torque that holds the pole with a distance left.
    """
    count = min(CHANGE_STARTS, protocol.starts)
    few = replace(protocol, starts=count, between=CHANGE_BETWEEN)
    trouble = ("--change-mass-at", str(CHANGE_AT), "--change-mass", str(CHANGE_FACTOR))
    options = (*METHODS["gain"].drive, *trouble)
    runs = {}
    for name, frozen in (("online", ()), ("frozen", ("--frozen",))):
        with koop_serve(plant, weights) as endpoint:
            runs[name] = run(plant, (*options, *frozen), endpoint, few, CHANGE_TARGET)
    return Change(plant, CHANGE_AT, CHANGE_FACTOR, runs)


def open_loop(plant: Plant, weights: Path, protocol: Protocol) -> OpenLoop:
    """Follow one plan from each start blindly, as the paper does."""
    all_starts = replace(protocol, rate="max")
    with koop_serve(plant, weights) as endpoint:
        found = run(plant, _BLIND, endpoint, all_starts)
        shown = run(plant, _BLIND, endpoint, _shown(all_starts))
    arrived = ~np.isnan(found.angles[:, -1])
    return OpenLoop(
        arrival=np.abs(found.angles[arrived, -1]),
        planned=shown.planned,
        achieved=shown.frames[1:],
        angles=shown.angles[0],
        torques=shown.torques[0, :-1],
    )


def closed_loop(plant: Plant, weights: Path, protocol: Protocol) -> Trials:
    """One drive to look at."""
    with koop_serve(plant, weights) as endpoint:
        return run(plant, METHODS["mpc"].drive, endpoint, _shown(protocol))


def _shown(protocol: Protocol) -> Protocol:
    return replace(protocol, starts=1, between=(SHOWN, SHOWN))
