"""Whole trajectories: a pure function of the system, the regime and the seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from koop_clients.mechanics.excitation import Regime, excitation
from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import Simulator, State, random_state, with_pole
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


def simulate(
    system: System, regime: Regime, rng: np.random.Generator, frames: int, high: bool = False
) -> Trajectory:
    """Simulate and draw `frames` frames; `high` starts a free plant anywhere, not only low."""
    policy, reference = excitation(system, regime, rng)
    state = (
        random_state(system, rng, high)
        if reference is None
        else with_pole(system, *_disturbed(reference(0.0), rng))
    )
    states, controls = [state], []
    simulator = Simulator(system)
    for number in range(frames - 1):
        state, torque = simulator.frame(state, policy, number)
        states.append(state)
        controls.append(torque)
    pictures = Renderer(system).sequence(np.stack([s.q for s in states]))
    return Trajectory(pictures, np.array(controls)[:, None], _stack(states))


def _disturbed(start: tuple[float, float], rng: np.random.Generator) -> tuple[float, float]:
    """A random initial configuration near the reference's."""
    return start[0] + rng.normal(0, 0.3), start[1] + rng.normal(0, 0.5)


def _stack(states: list[State]) -> np.ndarray:
    return np.stack([np.concatenate([s.q, s.v]) for s in states])
