"""The cylinder's trajectories frame by frame, computed by one process or several."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Literal

import numpy as np

from koop_clients.flow.cylinder import CylinderFlow
from koop_clients.flow.forcing import Regime, law
from koop_clients.flow.plant import FlowPlant, starting
from koop_clients.flow.settings import FlowSettings
from koop_clients.flow.spinup import Progress, developed, steady

# The paper's lengths (A.3) [frames]; one frame of the steady flow is as good as many.
_FORCED = 5000
FRAMES = {
    "rest": 4328,
    "chirp": _FORCED,
    "sweeps": _FORCED,
    "schedule": _FORCED,
    "feedback": _FORCED,
    "mix": _FORCED,
    "steady": 1,
}


@dataclass(frozen=True)
class FlowRecipe:
    """What a recording of the cylinder is made of.

    Attributes:
        settings: of the flow.
        regimes: how the cylinder turns, the trajectories in turn; or `steady` alone: the steady
            flow, all frames alike.
        trajectories: how many, each from a phase and with a schedule of its own.
        frames: of each; 0 takes the paper's length.
        seed: of phases and schedules.
    """

    settings: FlowSettings
    regimes: tuple[Regime | Literal["steady"], ...] = ("rest",)
    trajectories: int = 1
    frames: int = 0
    seed: int = 0

    @property
    def length(self) -> int:
        """Frames of each trajectory."""
        return self.frames or FRAMES[self.regimes[0]]

    @property
    def is_actuated(self) -> bool:
        """Whether the cylinder may turn."""
        return self.regimes[0] not in ("rest", "steady")

    @property
    def is_steady(self) -> bool:
        """Whether it is the steady flow."""
        return self.regimes[0] == "steady"

    def regime(self, index: int) -> Regime | Literal["steady"]:
        """How the cylinder of trajectory `index` turns."""
        return self.regimes[index % len(self.regimes)]


@dataclass(frozen=True, eq=False)
class Moment:
    """A frame (4, H, W) float16, the probe's velocity [U], and the rotation that follows [U/D]."""

    picture: np.ndarray
    probe: float
    rotation: float


# Of which trajectory, and its number there.
Numbered = tuple[int, int, Moment]


def moments(
    recipe: FlowRecipe, workers: int, spun_up: Progress | None = None
) -> Iterator[Numbered]:
    """Every moment of every trajectory, those of one in order; the same on any worker count.

    `spun_up` hears how the flow develops, if it must. Raises DivergedError.
    """
    flow = CylinderFlow(recipe.settings)
    if min(workers, recipe.trajectories) == 1 or recipe.is_steady:
        yield from _numbered(flow, recipe, range(recipe.trajectories), spun_up)
        return
    developed(flow, spun_up)  # once, before all workers ask for it
    yield from _gathered(recipe, min(workers, recipe.trajectories))


def _gathered(recipe: FlowRecipe, workers: int) -> Iterator[Numbered]:
    context = multiprocessing.get_context("spawn")
    processes, ends = [], []
    try:
        for first in range(workers):
            end, other = context.Pipe(duplex=False)
            share = range(first, recipe.trajectories, workers)
            process = context.Process(target=_send, args=(other, recipe, share), daemon=True)
            process.start()
            other.close()  # so that the end of the process is the end of the pipe
            processes.append(process)
            ends.append(end)
        yield from _received(ends)
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _received(ends: list[Connection]) -> Iterator[Numbered]:
    """What comes out of any of the pipes, until each has sent None."""
    ends = list(ends)
    while ends:
        for end in wait(ends):
            assert isinstance(end, Connection)
            try:
                found: Any = end.recv()
            except EOFError as error:
                raise OSError("a process that simulates was killed; try fewer --workers") from error
            if isinstance(found, Exception):
                raise found
            if found is None:
                ends.remove(end)
            else:
                yield found


def _send(end: Connection, recipe: FlowRecipe, share: range) -> None:
    try:
        for moment in _numbered(CylinderFlow(recipe.settings), recipe, share):
            end.send(moment)
        end.send(None)
    except Exception as error:  # whatever it is, the user sees it
        end.send(error)


def _numbered(
    flow: CylinderFlow, recipe: FlowRecipe, share: range, spun_up: Progress | None = None
) -> Iterator[Numbered]:
    for index in share:
        for k, moment in enumerate(_moments(flow, recipe, index, spun_up)):
            yield index, k, moment


def _moments(
    flow: CylinderFlow, recipe: FlowRecipe, index: int, spun_up: Progress | None
) -> Iterator[Moment]:
    regime = recipe.regime(index)
    if regime == "steady":
        state = steady(flow, spun_up)
        yield from [Moment(flow.picture(state), flow.probe(state), 0.0)] * recipe.length
        return
    seed = (recipe.seed, index)
    plant = FlowPlant(flow, law(regime, seed), starting(flow, seed, spun_up))
    for _ in range(recipe.length):
        picture, probe = plant.draw(), plant.probe
        yield Moment(picture, probe, plant.advance())
