"""Who turns a cylinder that is driven: the service by its commands, or the reference controller."""

from __future__ import annotations

from itertools import groupby, pairwise
from typing import Protocol

from koop_clients.flow.cylinder import Turn
from koop_clients.flow.forcing import Law
from koop_clients.flow.plant import FlowPlant
from koop_clients.flow.settings import FRAME_INTERVAL
from koop_clients.sim_client.driving.commanded import Commanded
from koop_clients.sim_client.driving.driver import Deciding, Independent

PARTS = 15
"""How often within a frame's interval a new command can take over from the one before."""

STEP = FRAME_INTERVAL / PARTS
"""The same as a time [s]."""


class FlowDriver(Deciding, Protocol):
    """Decides how one cylinder turns, an interval at a time, when the interval is over."""

    def turns(self, plant: FlowPlant) -> list[Turn]:
        """What fills the interval after the plant's present frame."""
        ...


class Reference(Independent):
    """A driver that measures the velocity behind the cylinder."""

    def __init__(self, law: Law) -> None:
        super().__init__()
        self._law = law

    def turns(self, plant: FlowPlant) -> list[Turn]:
        """One rotation for all of the interval, as the law says at its beginning."""
        rotation = self._law(plant.number, plant.probe)
        return [Turn(plant.flow.settings.frame_steps, rotation)]


class Obeying(Commanded):
    """A driver that obeys the service's commands from the moment at which each comes."""

    def settle(self, number: int) -> None:
        """Let the interval after frame `number` end, and take in what came during it.

        Where simulating takes longer than a frame's interval the next frame is due at once, and the
        command would have had no time at all. Raises as Commanded's.
        """
        self.await_command(number)
        super().settle(number)

    def turns(self, plant: FlowPlant) -> list[Turn]:
        """A rotation for each part of the interval, equal neighbours in one."""
        steps, number = plant.flow.settings.frame_steps, plant.number
        edges = [steps * part // PARTS for part in range(PARTS + 1)]
        parts = (
            Turn(end - start, self.control(number, part))
            for part, (start, end) in enumerate(pairwise(edges))
        )
        return [
            Turn(sum(turn.steps for turn in same), rotation)
            for rotation, same in groupby(parts, key=lambda turn: turn.rotation)
        ]
