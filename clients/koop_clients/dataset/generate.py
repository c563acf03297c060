"""Many trajectories in parallel, each a pure function of (seed, index)."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from koop_clients.mechanics.excitation import Regime
from koop_clients.mechanics.systems import build_system, sample_parameters
from koop_clients.mechanics.trajectories import Trajectory, simulate


@dataclass(frozen=True)
class Recipe:
    """What a data set is made of.

    `regimes` are weights; a trajectory's regime is drawn from them. `frames` is the length of each
    trajectory in frames (50 ms). `vary` draws masses and lengths anew for each trajectory.
    """

    system: str
    frames: int
    regimes: Mapping[Regime, float]
    seed: int
    vary: bool = False
    high: bool = False


@dataclass(frozen=True, eq=False)
class Sample:
    """One trajectory and how it came about."""

    trajectory: Trajectory
    parameters: Mapping[str, float]
    regime: Regime


def generate(recipe: Recipe, count: int, workers: int) -> Iterator[Sample]:
    """`count` samples in order; the same recipe gives the same samples on any worker count."""
    jobs = [(recipe, index) for index in range(count)]
    if workers <= 1:
        yield from map(_sample, jobs)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap(_sample, jobs, chunksize=4)


def _sample(job: tuple[Recipe, int]) -> Sample:
    recipe, index = job
    rng = np.random.default_rng((recipe.seed, index))
    names = sorted(recipe.regimes)
    weights = np.array([recipe.regimes[name] for name in names])
    regime: Regime = names[int(rng.choice(len(names), p=weights / weights.sum()))]
    parameters = sample_parameters(recipe.system, rng) if recipe.vary else {}
    system = build_system(recipe.system, parameters)
    trajectory = simulate(system, regime, rng, recipe.frames, recipe.high)
    return Sample(trajectory, system.parameters, regime)
