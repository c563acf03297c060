"""When a command acts: simulated time between a frame and the answer to it. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from koop_clients.mechanics.simulation import FRAME_INTERVAL, STEP


@dataclass(frozen=True)
class Timing:
    """How times on the wall and in the simulation belong together.

    Attributes:
        speed: simulated over real time; infinite where simulated time waits for the service.
        camera: how long a frame takes to the service [s simulated].
        interval: from one frame to the next [s simulated].
        step: how often the control may change [s simulated].
    """

    speed: float
    camera: float = 0.0
    interval: float = FRAME_INTERVAL
    step: float = STEP

    @property
    def waits(self) -> bool:
        """Whether simulated time stands still until the service has answered."""
        return math.isinf(self.speed)

    @property
    def wall_interval(self) -> float:
        """From one frame to the next on the wall [s]; 0 where simulated time waits."""
        return self.interval / self.speed

    def age(self, lag: float) -> float:
        """How old a frame is [s simulated] when its command comes, `lag` [s] after it was put."""
        return self.camera + (0.0 if self.waits else lag * self.speed)

    def frames(self, lag: float) -> int:
        """The same in frames: to the interval of which the command gets the larger part."""
        return round(self.age(lag) / self.interval)

    def is_there(self, seq: int, lag: float, number: int, step: int) -> bool:
        """Whether the command from frame `seq` can act in a step of interval `number`."""
        return (number - seq) * self.interval + step * self.step >= self.age(lag) - 1e-9
