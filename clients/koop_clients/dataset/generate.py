"""Many trajectories in parallel, each a pure function of (seed, index)."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from koop_clients.mechanics.excitation import Regime
from koop_clients.mechanics.systems import System, build_system, sample_parameters
from koop_clients.mechanics.trajectories import Change, Trajectory, simulate


@dataclass(frozen=True)
class Recipe:
    """What a data set is made of.

    `regimes` are weights; a trajectory's regime is drawn from them. `frames` is the length of each
    trajectory in frames (50 ms). `vary` draws masses and lengths anew for each trajectory. From
    frame `change_at` on, its parameters are multiplied by `factors`; 0 never changes them.
    """

    system: str
    frames: int
    regimes: Mapping[Regime, float]
    seed: int
    vary: bool = False
    high: bool = False
    change_at: int = 0
    factors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Sample:
    """One trajectory and how it came about; `change` is empty where nothing changes."""

    trajectory: Trajectory
    parameters: Mapping[str, float]
    regime: Regime
    change: Mapping[str, float] = field(default_factory=dict)

    @property
    def manifest(self) -> dict[str, Any]:
        """Its entry in the file."""
        change = {"change": dict(self.change)} if self.change else {}
        return {"regime": self.regime, **self.parameters, **change}

    @property
    def leaves_picture(self) -> bool:
        """Whether anything is drawn on the outermost pixels."""
        frames = self.trajectory.frames
        return bool(frames[:, [0, -1]].any() or frames[:, :, [0, -1]].any())


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
    change = _change(recipe, system)
    trajectory = simulate(system, regime, rng, recipe.frames, recipe.high, change)
    told = {} if change is None else {"at": change.at, **change.system.parameters}
    return Sample(trajectory, system.parameters, regime, told)


def _change(recipe: Recipe, system: System) -> Change | None:
    if not recipe.change_at:
        return None
    factors = {name: recipe.factors.get(name, 1.0) for name in system.parameters}
    changed = {name: factors[name] * value for name, value in system.parameters.items()}
    return Change(recipe.change_at, build_system(system.name, changed))
