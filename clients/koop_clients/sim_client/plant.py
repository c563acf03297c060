"""A simulated plant that can look ahead of what it has shown."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import (
    Disturbance,
    Policy,
    Simulator,
    State,
    without_drift,
)
from koop_clients.mechanics.systems import System


class _Interval(NamedTuple):
    """From one frame to the next: where it starts, and the mean torque [N m] that acts in it."""

    number: int
    state: State
    torque: float


class Plant:
    """One simulated trajectory, frame by frame; its torque may change every 5 ms.

    States are values and torque laws depend only on time and state, so the plant can be simulated
    ahead of the frames shown: this is how the true future controls of a prediction are known. A new
    torque law drops what was looked at and goes on from the present frame.
    """

    def __init__(self, system: System, policy: Policy, state: State) -> None:
        self.system = system
        self._simulator = Simulator(system)
        self._renderer = Renderer(system)
        self._policy = policy
        self._disturbance: Disturbance | None = None
        self._shift = np.zeros(system.model.nq)
        self._ahead: deque[_Interval] = deque()
        self._end = (0, state)

    @property
    def number(self) -> int:
        """Number of the present frame, from 0."""
        return self._present()[0]

    @property
    def state(self) -> State:
        """State at the present frame."""
        return self._present()[1]

    @property
    def angle(self) -> float:
        """Of the (first) pole [rad]."""
        return float(self.state.q[self.system.pole])

    @property
    def rate(self) -> float:
        """Of the (first) pole [rad/s]."""
        return float(self.state.v[self.system.pole])

    def draw(self) -> np.ndarray:
        """The present frame, (64, 64) uint8."""
        return self._renderer(self.state.q)

    def look_ahead(self, frames: int) -> np.ndarray:
        """Mean torques [N m] of the next intervals under the present law, (frames, 1)."""
        self._simulate(frames)
        return np.array([[self._ahead[i].torque] for i in range(frames)])

    def advance(self) -> float:
        """Go to the next frame; the mean torque that acted on the way [N m].

        A disturbance is no part of it.
        """
        self._simulate(1)
        return self._ahead.popleft().torque

    def obey(self, policy: Policy) -> None:
        """From the present frame on the torque follows `policy`."""
        self._forget()
        self._policy = policy

    def disturb(self, disturbance: Disturbance) -> None:
        """From the present frame on this acts beside the policy's torque."""
        self._forget()
        self._disturbance = disturbance

    def become(self, system: System) -> None:
        """From the present frame on the plant is `system`, and goes on with its state.

        A free cart alone gets another velocity: with its old one, and other masses, it would have a
        momentum that carries it out of the picture.
        """
        self._forget()
        number, state = self._end
        resting = without_drift(system, state)
        self._shift = state.q - resting.q
        self._end = (number, State(state.q, resting.v))
        self.system = system
        self._simulator, self._renderer = Simulator(system), Renderer(system)

    def _present(self) -> tuple[int, State]:
        return self._ahead[0][:2] if self._ahead else self._end

    def _forget(self) -> None:
        self._end = self._present()
        self._ahead.clear()

    def _simulate(self, frames: int) -> None:
        while len(self._ahead) < frames:
            number, state = self._end
            following, torque = self._simulator.frame(
                state, self._policy, number, self._disturbance
            )
            self._ahead.append(_Interval(number, state, torque))
            resting = without_drift(self.system, following)
            self._end = (number + 1, State(resting.q + self._shift, resting.v))
