"""Whole trajectories: a pure function of the system, the regime and the seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from koop_clients.mechanics.excitation import Regime, excitation
from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import (
    Policy,
    Simulator,
    State,
    random_state,
    with_pole,
    without_drift,
)
from koop_clients.mechanics.systems import System


@dataclass(frozen=True, eq=False)
class Trajectory:
    """T frames of one run.

    `frames` (T, 64, 64) uint8; `controls` (T-1, 1): the mean torque [N m] between frames k and k+1;
    `states` (T, 2 nv): configuration and velocity at each frame.
    """

    frames: np.ndarray
    controls: np.ndarray
    states: np.ndarray


@dataclass(frozen=True, eq=False)
class Change:
    """From frame number `at` (1 or more) on the plant is `system`, and goes on with its state.

    A free cart alone gets another velocity: with its old one, and other masses, it would have a
    momentum that carries it out of the picture.
    """

    at: int
    system: System


def simulate(
    system: System,
    regime: Regime,
    rng: np.random.Generator,
    frames: int,
    high: bool = False,
    change: Change | None = None,
) -> Trajectory:
    """Simulate and draw `frames` frames; `high` starts a free plant anywhere, not only low."""
    policy, reference = excitation(system, regime, rng)
    start = (
        random_state(system, rng, high)
        if reference is None
        else with_pole(system, *_disturbed(reference(0.0), rng))
    )
    if change is None or change.at >= frames:
        return _follow(system, policy, start, range(frames - 1))
    before = _follow(system, policy, start, range(change.at))
    state = State(*np.split(before.states[-1], 2))
    after = _follow(change.system, policy, state, range(change.at, frames - 1))
    return Trajectory(
        np.concatenate([before.frames[:-1], after.frames]),
        np.concatenate([before.controls, after.controls]),
        np.concatenate([before.states[:-1], after.states]),
    )


def _follow(system: System, policy: Policy, start: State, numbers: range) -> Trajectory:
    """From the frame at which `numbers` start to the one at which they stop, both drawn."""
    resting = without_drift(system, start)
    shift = start.q - resting.q  # of a cartpole's centre of mass, after a change of its masses
    states, controls = [State(start.q, resting.v)], np.zeros((len(numbers), 1))
    simulator = Simulator(system)
    for row, number in zip(controls, numbers, strict=True):
        state, row[0] = simulator.frame(states[-1], policy, number)
        state = without_drift(system, state)
        states.append(State(state.q + shift, state.v))
    pictures = Renderer(system).sequence(np.stack([s.q for s in states]))
    return Trajectory(pictures, controls, _stack(states))


def _disturbed(start: tuple[float, float], rng: np.random.Generator) -> tuple[float, float]:
    """A random initial configuration near the reference's."""
    return start[0] + rng.normal(0, 0.3), start[1] + rng.normal(0, 0.5)


def _stack(states: list[State]) -> np.ndarray:
    return np.stack([np.concatenate([s.q, s.v]) for s in states])
