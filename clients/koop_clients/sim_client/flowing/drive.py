"""One wake's drive: turned at random until its driver has a word, driven from there on."""

from __future__ import annotations

from collections import deque

import numpy as np

from koop_clients.flow.plant import FlowPlant
from koop_clients.sim_client.flowing.drivers import FlowDriver
from koop_clients.sim_client.flowing.outcome import FlowOutcome, outcome

_LONGEST = 2400  # frames kept
MOMENTUM = 1
"""The channel that pictures show: the momentum along the stream."""


class FlowLog:
    """Velocity behind the cylinder [U] and rotation [U/D] of each interval of a drive.

    In bounded memory; `pictures`, the momentum along the stream, stays empty unless it is kept.
    """

    def __init__(self, keep_pictures: bool) -> None:
        self._keep_pictures = keep_pictures
        self.pictures: deque[np.ndarray] = deque(maxlen=_LONGEST)
        self.probes: deque[float] = deque(maxlen=_LONGEST)
        self.rotations: deque[float] = deque(maxlen=_LONGEST)

    def add(self, picture: np.ndarray, probe: float, rotation: float) -> None:
        """A frame, the velocity that it has, and the rotation that acts after it."""
        if self._keep_pictures:
            self.pictures.append(picture[MOMENTUM])
        self.probes.append(probe)
        self.rotations.append(rotation)

    def series(self) -> np.ndarray:
        """(T, 2): velocity, rotation."""
        return np.column_stack([self.probes, self.rotations])

    def momenta(self, like: np.ndarray) -> np.ndarray:
        """(T, H, W) of the pictures kept, which are `like` (C, H, W)."""
        return np.array(self.pictures, like.dtype).reshape(-1, *like.shape[1:])


class FlowDrive:
    """The way of one wake to its target.

    Attributes:
        driver: who decides how the cylinder turns.
        log: what happened.
        natural: largest |v| behind a cylinder at rest [U].
        began: number of the first frame driven; None before.
    """

    def __init__(
        self,
        plant: FlowPlant,
        driver: FlowDriver,
        takeover: float,
        natural: float,
        keep_pictures: bool,
    ) -> None:
        self.driver = driver
        self.log = FlowLog(keep_pictures)
        self.natural = natural
        self.began: int | None = None
        self._plant = plant
        self._takeover = takeover
        self._picture = np.zeros(0)

    @property
    def has_given_up(self) -> bool:
        """Whether it will never begin."""
        return self.began is None and self.driver.has_given_up

    def shown(self, picture: np.ndarray) -> None:
        """The present frame was put."""
        self._picture = picture
        self.driver.shown(self._plant.number)

    def advance(self) -> float:
        """Go to the next frame, under whoever decides by now; the mean rotation [U/D]."""
        plant, number = self._plant, self._plant.number
        self.driver.settle(number)
        if self.began is None and number >= self._takeover and self.driver.speaks(number):
            self.began = number
        if self.began is None:
            return plant.advance()
        probe = plant.probe
        rotation = plant.turn(self.driver.turns(plant))
        self.log.add(self._picture, probe, rotation)
        return rotation

    def outcome(self) -> FlowOutcome | None:
        """What has become of the wake; None where it was not driven."""
        return outcome(self.log.probes, self.log.rotations, self.natural)
