"""One plant's drive: excited until its driver has a word, driven from there on, and judged."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from koop_clients.mechanics.systems import System, build_system
from koop_clients.sim_client.driving.driver import Driver
from koop_clients.sim_client.driving.outcome import Outcome, outcome
from koop_clients.sim_client.driving.trouble import disturbance, mass_change_frame
from koop_clients.sim_client.options import TroubleOptions
from koop_clients.sim_client.streaming import Stream

_LONGEST = 2400  # frames kept


class DriveLog:
    """Angle [rad], rate [rad/s] and torque [N m] at each frame of a drive, in bounded memory.

    `frames` stays empty unless they are to be kept.
    """

    def __init__(self, keep_frames: bool) -> None:
        self._keep_frames = keep_frames
        self.frames: deque[np.ndarray] = deque(maxlen=_LONGEST)
        self.angles: deque[float] = deque(maxlen=_LONGEST)
        self.rates: deque[float] = deque(maxlen=_LONGEST)
        self.torques: deque[float] = deque(maxlen=_LONGEST)

    def add(self, frame: np.ndarray, angle: float, rate: float, torque: float) -> None:
        """A frame, the state that it shows, and the torque that acts after it."""
        if self._keep_frames:
            self.frames.append(frame)
        self.angles.append(angle)
        self.rates.append(rate)
        self.torques.append(torque)

    def series(self) -> np.ndarray:
        """(T, 3): angle, rate, torque."""
        return np.column_stack([self.angles, self.rates, self.torques])


@dataclass(frozen=True)
class Course:
    """What a drive is to be.

    Attributes:
        takeover: number of the frame at which it begins, at the earliest.
        frames: how many it has; infinite until the end.
        target: angle to reach [rad].
        trouble: what goes wrong meanwhile.
        seed: of what is random in that.
    """

    takeover: int
    frames: float
    target: float
    trouble: TroubleOptions
    seed: tuple[int, ...]


class Drive:
    """The way of one plant to its target.

    Attributes:
        driver: who decides about its torque.
        log: what happened.
        began: number of the first frame driven; None before.
    """

    def __init__(self, stream: Stream, driver: Driver, course: Course, keep_frames: bool) -> None:
        self.driver = driver
        self.course = course
        self.log = DriveLog(keep_frames)
        self.began: int | None = None
        self._stream = stream
        self._plant = stream.plant
        self._frame = np.zeros(0)
        self._change_at: int | None = None

    @property
    def trajectory(self) -> str:
        """Its name."""
        return self._stream.source.trajectory

    @property
    def start(self) -> float:
        """Angle near which it is to begin [rad]."""
        return self._stream.start

    @property
    def is_over(self) -> bool:
        """Whether it has had its frames, or will never begin."""
        if self.began is None:
            return self.driver.has_given_up
        return self._plant.number >= self.began + self.course.frames

    def shown(self, frame: np.ndarray) -> None:
        """The present frame was put."""
        self._frame = frame
        self.driver.shown(self._plant.number)

    def advance(self) -> None:
        """Go to the next frame, under whoever decides by now."""
        number = self._plant.number
        self.driver.settle(number)
        if self.began is None and number >= self.course.takeover and self.driver.speaks(number):
            self._begin(number)
        if number == self._change_at:
            self._plant.become(_heavier(self._plant.system, self.course.trouble.change_mass))
        angle, rate = self._plant.angle, self._plant.rate
        torque = self._stream.advance()
        if self.began is not None:
            self.log.add(self._frame, angle, rate, torque)

    def outcome(self) -> Outcome | None:
        """What has become of the pole; None where it was not driven."""
        log = self.log
        return outcome(log.angles, log.rates, log.torques, self.course.target)

    def _begin(self, number: int) -> None:
        self.began = number
        trouble = self.course.trouble
        self._change_at = mass_change_frame(trouble, number)
        self._plant.obey(self.driver.torque)
        self._plant.disturb(disturbance(trouble, number, self.course.seed))


def _heavier(system: System, factor: float) -> System:
    mass = system.parameters["mass"] * factor
    return build_system(system.name, {**system.parameters, "mass": mass})
