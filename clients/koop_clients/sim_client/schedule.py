"""What drives the plant before the service may: the phases of a run and their torque laws.

An actuated plant is excited around its hanging position, where a second of open-loop prediction
makes sense at all: near upright the plant is unstable, and a model's smallest error grows thirty
times a second. Before lqr takes over the pole is lifted to the start and probed there, so that the
service knows the region in which it will act.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from koop_clients.mechanics.excitation import (
    Lift,
    excitation,
    near_reference,
    probing_tracking,
    soft_tracking,
)
from koop_clients.mechanics.simulation import (
    FRAME_INTERVAL,
    Policy,
    State,
    random_state,
    with_pole,
)
from koop_clients.mechanics.systems import System
from koop_clients.sim_client.arguments import Arguments

_GENTLE = 0.5  # share of the random torque that training sees
_LONGEST_APPROACH = 5.0  # s before lqr takes over; half of the time where that is less
_LIFT = 0.4  # share of it


def takeover_frame(arguments: Arguments) -> float:
    """Number of the first frame that lqr drives; infinite without lqr."""
    return round(arguments.lqr.learn / FRAME_INTERVAL) if arguments.drive == "lqr" else math.inf


def approach_frame(arguments: Arguments) -> float:
    """Number of the frame at which the pole's way to the start begins; infinite without lqr."""
    return takeover_frame(arguments) - round(_approach(arguments) / FRAME_INTERVAL)


def _approach(arguments: Arguments) -> float:
    """How long the way to the start and the probing there take [s]."""
    return min(_LONGEST_APPROACH, arguments.lqr.learn / 2)


def excited(arguments: Arguments, system: System, rng: np.random.Generator) -> tuple[Policy, State]:
    """The torque law until the service takes over, and the initial state."""
    if not arguments.is_actuated:
        return excitation(system, "free", rng)[0], random_state(system, rng)
    hanging = math.copysign(math.pi, arguments.lqr.start_angle)
    reference = near_reference(rng, hanging)
    policy = soft_tracking(system, reference, rng, _GENTLE).policy()
    state = with_pole(system, *reference(0.0))
    if arguments.drive == "lqr":
        begin = approach_frame(arguments)
        duration = max(FRAME_INTERVAL, _LIFT * _approach(arguments))
        lift = Lift(hanging, arguments.lqr.start_angle, begin * FRAME_INTERVAL, duration)
        # Held for each frame, as the service's torques will be.
        probing = replace(probing_tracking(system, lift, rng), hold_frame=True)
        policy = _in_turn(policy, probing.policy(), begin)
    return policy, state


def _in_turn(first: Policy, then: Policy, frame: float) -> Policy:
    """`first` until `frame`, `then` from there on."""
    return lambda number, step, state: (first if number < frame else then)(number, step, state)
