"""Plans from frame to frame: each from where the ones before are leading, taken to be obeyed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koop_service.control.plan import roll_forward
from koop_service.control.solve import QPSolution
from koop_service.prediction.model import LinearModel
from koop_service.serving.steering.aims import Aim
from koop_service.serving.steering.planning import Departure, Gain, follow, gain_of, steer

Array = NDArray[np.float64]


class Schedule:
    """The control of each interval as planned so far: by the newest plan, whose last row stays."""

    def __init__(self, first: int, control: Array) -> None:
        """One control (p,) from interval `first` on."""
        self._first = first
        self._rows = control[None]

    def between(self, start: int, stop: int) -> Array:
        """Controls (stop - start, p) of the intervals start ... stop-1."""
        wanted = np.arange(start, stop) - self._first
        return self._rows[np.clip(wanted, 0, len(self._rows) - 1)]

    def replace(self, oldest: int, start: int, controls: Array) -> None:
        """Plan (N, p) from interval `start` on; nobody asks for those before `oldest` any more."""
        self._rows = np.concatenate([self.between(oldest, start), controls])
        self._first = oldest


@dataclass(frozen=True, eq=False)
class Plan:
    """history: (h, n), expected when the first control acts, in interval `start`."""

    start: int
    history: Array
    solution: QPSolution


class Course:
    """An aim followed from frame `seq` on, which its sequences count from."""

    def __init__(self, aim: Aim, seq: int, schedule: Schedule) -> None:
        self.aim = aim
        self.schedule = schedule
        self._origin = seq
        self._last: QPSolution | None = None
        self._gain: Gain | None = None
        self._planned = seq

    def plan(self, model: LinearModel, history: Array, seq: int) -> Plan:
        """From the codes (h, n) up to frame `seq`; ProtocolError where there is no plan."""
        start = self.start(seq)
        acting = self.schedule.between(seq - 1, start)
        with np.errstate(over="ignore", invalid="ignore"):
            history = roll_forward(model, history, acting[1:])
        departure = Departure(model, history, acting[-1], seq - self._origin)
        found = self._solve(departure, seq - self._planned)
        self.schedule.replace(seq - 1, start, found.u)
        self._last, self._planned = found, seq
        return Plan(start, history, found)

    def _solve(self, departure: Departure, since: int) -> QPSolution:
        if self.aim.query.method != "gain":
            return steer(self.aim, departure, self._last, since)
        self._gain = gain_of(self.aim, departure, self._gain)
        return follow(self.aim, departure, self._gain)

    def rest(self, seq: int) -> Array:
        """(N, p): what is left of the last plan at frame `seq`."""
        start = self.start(seq)
        return self.schedule.between(start, start + self.aim.query.horizon)

    def start(self, seq: int) -> int:
        """The interval in which a plan made at frame `seq` can begin."""
        return seq + self.aim.query.delay
