"""A simulated plant that can look ahead of what it has shown."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import Policy, Simulator, State, without_drift
from koop_clients.mechanics.systems import System


class _Interval(NamedTuple):
    """From one frame to the next: where it starts, and the mean torque [N m] that acts in it."""

    number: int
    state: State
    torque: float


class Plant:
    """One simulated trajectory.

    States are values and torque laws depend only on time and state, so the plant can be simulated
    ahead of the frames shown: this is how the true future controls of a prediction are known. A new
    torque law drops what was looked at and goes on from the present frame.
    """

    def __init__(self, system: System, policy: Policy, state: State) -> None:
        self.system = system
        self._simulator = Simulator(system)
        self._renderer = Renderer(system)
        self._policy = policy
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

    def draw(self) -> np.ndarray:
        """The present frame, (64, 64) uint8."""
        return self._renderer(self.state.q)

    def look_ahead(self, frames: int) -> np.ndarray:
        """Mean torques [N m] of the next intervals under the present law, (frames, 1)."""
        self._simulate(frames)
        return np.array([[self._ahead[i].torque] for i in range(frames)])

    def advance(self) -> float:
        """Go to the next frame; the mean torque that acted on the way [N m]."""
        self._simulate(1)
        return self._ahead.popleft().torque

    def obey(self, policy: Policy) -> None:
        """From the present frame on the torque follows `policy`."""
        self._end = self._present()
        self._ahead.clear()
        self._policy = policy

    def _present(self) -> tuple[int, State]:
        return self._ahead[0][:2] if self._ahead else self._end

    def _simulate(self, frames: int) -> None:
        while len(self._ahead) < frames:
            number, state = self._end
            following, torque = self._simulator.frame(state, self._policy, number)
            self._ahead.append(_Interval(number, state, torque))
            self._end = (number + 1, without_drift(self.system, following))
