"""Plants and their streams: what is shown to the service, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import zenoh

from koop_clients.mechanics.rendering import RENDERER
from koop_clients.mechanics.systems import System
from koop_clients.replay.log import SourceLog
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.plant import Plant
from koop_clients.sim_client.record import Scorebook
from koop_clients.sim_client.schedule import excited
from koop_clients.sim_client.scoring import Judge
from koop_clients.sources import FrameSource

_START = 2  # of a plant's random numbers


@dataclass(eq=False)
class Stream:
    """One plant, its source, and the predictions made about it.

    Attributes:
        plant: what moves.
        source: puts its frames.
        start: angle near which a drive begins [rad].
        judge: of the predictions.
        frames: how many were put.
    """

    plant: Plant
    source: FrameSource
    start: float
    judge: Judge = field(default_factory=Judge)
    frames: int = 0

    def show(self, book: Scorebook) -> np.ndarray:
        """Put the present frame; forecasts that it completes go into `book`."""
        frame = self.plant.draw()
        seq = self.source.put_frame(frame)
        self.frames += 1
        for judged in self.judge.see(seq, frame):
            book.add(judged)
        return frame

    def advance(self) -> float:
        """Go to the next frame, and put the control that acted on the way; its mean [N m]."""
        torque = self.plant.advance()
        if self.source.control_size:
            self.source.put_control([torque])
        return torque


def open_streams(
    arguments: Arguments,
    system: System,
    target: float,
    session: zenoh.Session,
    log: SourceLog | None = None,
) -> list[Stream]:
    """The plants that the arguments ask for, at their initial states; `target` is in rad."""
    return [
        _stream(arguments, system, target, session, log, index)
        for index in range(arguments.trajectories)
    ]


def _stream(
    arguments: Arguments,
    system: System,
    target: float,
    session: zenoh.Session,
    log: SourceLog | None,
    index: int,
) -> Stream:
    seed = (arguments.seed, arguments.first + index)
    share = float(np.random.default_rng((*seed, _START)).random())
    start = arguments.driving.start_angle(target, share)
    policy, state = excited(arguments, system, target, start, np.random.default_rng(seed))
    source = FrameSource(
        session,
        arguments.trajectory(index),
        control_size=int(arguments.is_actuated),
        renderer=RENDERER,
        log=log,
    )
    return Stream(Plant(system, policy, state), source, start)
