"""Plants and their streams: what is shown to the service, frame by frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import zenoh

from koop_clients.mechanics.excitation import (
    constant_reference,
    excitation,
    near_reference,
    probing_tracking,
)
from koop_clients.mechanics.rendering import RENDERER
from koop_clients.mechanics.simulation import (
    FRAME_INTERVAL,
    Policy,
    State,
    random_state,
    with_pole,
)
from koop_clients.mechanics.systems import System
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.plant import Plant
from koop_clients.sim_client.record import Scorebook
from koop_clients.sim_client.scoring import Judge
from koop_clients.sources import FrameSource

_APPROACH_FRAMES = 25  # before lqr takes over


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
                f"{system.name}/{arguments.first + index}",
                control_size=int(arguments.is_actuated),
                renderer=RENDERER,
            ),
        )
        for index in range(arguments.trajectories)
    ]


def takeover_frame(arguments: Arguments) -> float:
    """Number of the first frame that lqr drives; infinite without lqr."""
    return round(arguments.lqr.learn / FRAME_INTERVAL) if arguments.drive == "lqr" else math.inf


def _plant(arguments: Arguments, system: System, index: int) -> Plant:
    rng = np.random.default_rng((arguments.seed, index))
    policy, state = _initial(arguments, system, rng)
    if arguments.drive == "lqr":
        approach = probing_tracking(system, constant_reference(arguments.lqr.start_angle), rng)
        last = int(takeover_frame(arguments)) - _APPROACH_FRAMES
        policy = _in_turn(policy, approach.policy(), last)
    return Plant(system, policy, state)


def _initial(
    arguments: Arguments, system: System, rng: np.random.Generator
) -> tuple[Policy, State]:
    if not arguments.is_actuated:
        return excitation(system, "free", rng)[0], random_state(system, rng)
    centre = arguments.lqr.target_angle if arguments.drive == "lqr" else 0.0
    reference = near_reference(rng, centre)
    policy = probing_tracking(system, reference, rng).policy()
    return policy, with_pole(system, *reference(0.0))


def _in_turn(first: Policy, then: Policy, frame: int) -> Policy:
    """`first` until `frame`, `then` from there on."""
    return lambda number, step, state: (first if number < frame else then)(number, step, state)
