"""Plants and their streams: what is shown to the service, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import zenoh

from koop_clients.mechanics.rendering import RENDERER
from koop_clients.mechanics.systems import System
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.plant import Plant
from koop_clients.sim_client.record import Scorebook
from koop_clients.sim_client.schedule import excited
from koop_clients.sim_client.scoring import Judge
from koop_clients.sources import FrameSource


@dataclass(eq=False)
class Stream:
    """One plant, its source, and the predictions made about it."""

    plant: Plant
    source: FrameSource
    judge: Judge = field(default_factory=Judge)

    def show(self, book: Scorebook) -> np.ndarray:
        """Put the present frame; forecasts that it completes go into `book`."""
        frame = self.plant.draw()
        seq = self.source.put_frame(frame)
        for judged in self.judge.see(seq, frame):
            book.add(judged)
        return frame

    def advance(self) -> float:
        """Put the control that follows the frame, and go to the next; the mean torque [N m]."""
        torque = self.plant.advance()
        if self.source.control_size:
            self.source.put_control([torque])
        return torque


def open_streams(arguments: Arguments, system: System, session: zenoh.Session) -> list[Stream]:
    """The plants that the arguments ask for, at their initial states."""
    return [
        Stream(
            _plant(arguments, system, index),
            FrameSource(
                session,
                arguments.trajectory(index),
                control_size=int(arguments.is_actuated),
                renderer=RENDERER,
            ),
        )
        for index in range(arguments.trajectories)
    ]


def _plant(arguments: Arguments, system: System, index: int) -> Plant:
    rng = np.random.default_rng((arguments.seed, index))
    return Plant(system, *excited(arguments, system, rng))
