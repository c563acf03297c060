"""What moves the plant before a drive: its phases and their torque laws.

An actuated plant is excited around its hanging position, where a second of open-loop prediction
makes sense at all: near upright the plant is unstable, and a model's smallest error grows thirty
times a second. Before a drive it is excited around the target, the region in which control acts,
and brought to its start at last. A model that only knows the start drives much worse.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from koop_clients.mechanics.excitation import (
    Motion,
    Passage,
    Rest,
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
_LONGEST_APPROACH, _APPROACH = 10.0, 0.7  # s before the drive; share of the time if that is less
_LIFT, _SETTLE, _STILL = 0.2, 0.12, 0.03  # shares of it: to the target, to the start, at the start


def approach_frame(arguments: Arguments) -> float:
    """Number of the frame at which the pole leaves hanging; infinite without a drive."""
    return arguments.takeover - round(_approach(arguments) / FRAME_INTERVAL)


def _approach(arguments: Arguments) -> float:
    """How long the excitation around the target takes, the ways there and to the start too [s]."""
    return max(FRAME_INTERVAL, min(_LONGEST_APPROACH, _APPROACH * arguments.driving.learn))


def excited(
    arguments: Arguments,
    system: System,
    target: float,
    start: float,
    rng: np.random.Generator,
) -> tuple[Policy, State]:
    """The torque law until the drive from `start` to `target` [rad], and the initial state."""
    if not arguments.is_actuated:
        return excitation(system, "free", rng)[0], random_state(system, rng)
    hanging = math.copysign(math.pi, start)
    reference = near_reference(rng, hanging)
    policy = soft_tracking(system, reference, rng, _GENTLE).policy()
    state = with_pole(system, *reference(0.0))
    if arguments.drives:
        begin, length = approach_frame(arguments), _approach(arguments)
        path = _path((hanging, target, start), begin * FRAME_INTERVAL, length, rng)
        # Held for each frame, as the service's torques will be.
        probing = replace(probing_tracking(system, path, rng), hold_frame=True)
        policy = _in_turn(policy, probing.policy(), begin)
    return policy, state


def _path(
    angles: tuple[float, float, float], begin: float, length: float, rng: np.random.Generator
) -> Motion:
    """From the first angle [rad] to about the second, and to the last one `length` [s] later."""
    first, around, last = angles
    up = Passage(Rest(first), near_reference(rng, around), begin, _LIFT * length)
    settle = begin + (1 - _SETTLE - _STILL) * length
    return Passage(up, Rest(last), settle, _SETTLE * length)


def _in_turn(first: Policy, then: Policy, frame: float) -> Policy:
    """`first` until `frame`, `then` from there on."""
    return lambda number, step, state: (first if number < frame else then)(number, step, state)
