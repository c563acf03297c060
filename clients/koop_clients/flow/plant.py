"""One simulated wake, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from koop_clients.flow.cylinder import CylinderFlow, Turn
from koop_clients.flow.forcing import Law, Seed
from koop_clients.flow.spinup import Progress, developed

_START = 1 << 20  # of the random numbers; schedules count up from 0
_PHASES = 16  # frames: nearly two periods of the shedding
_SWINGING = 20  # frames: more than two


class FlowPlant:
    """A flow, the law that turns its cylinder, and the present frame."""

    def __init__(self, flow: CylinderFlow, law: Law, state: np.ndarray) -> None:
        self.flow = flow
        self.state = state
        self.number = 0
        self._law = law

    @property
    def probe(self) -> float:
        """Transverse velocity behind the cylinder [U]."""
        return self.flow.probe(self.state)

    def draw(self) -> np.ndarray:
        """The present frame, (4, H, W) float16."""
        return self.flow.picture(self.state)

    def advance(self) -> float:
        """Go to the next frame; how the cylinder turned on the way [U/D].

        Raises DivergedError.
        """
        return self.turn([Turn(self.flow.settings.frame_steps, self.lawful())])

    def lawful(self) -> float:
        """How the law would turn the cylinder now [U/D]."""
        return self._law(self.number, self.probe)

    def look_ahead(self, frames: int) -> np.ndarray:
        """Rotations [U/D] of the next intervals, (frames,), by a law that looks at no velocity."""
        return np.array([self._law(self.number + k, 0.0) for k in range(frames)])

    def turn(self, turns: Sequence[Turn]) -> float:
        """Go to the next frame by `turns`, which fill one; their mean rotation [U/D].

        Raises DivergedError.
        """
        self.state = self.flow.turned(self.state, turns)
        self.number += 1
        if len(turns) == 1:
            return turns[0].rotation
        return sum(t.steps * t.rotation for t in turns) / sum(t.steps for t in turns)

    def obey(self, law: Law) -> None:
        """From the present frame on the cylinder turns by `law`."""
        self._law = law


def starting(
    flow: CylinderFlow, seed: Seed, progress: Progress | None = None,
    folder: Path | None = None,
) -> np.ndarray:  # fmt: skip
    """A developed wake at a random phase; the state of a trajectory's first frame."""
    state = developed(flow, progress, folder)
    for _ in range(int(np.random.default_rng((*seed, _START)).integers(_PHASES))):
        state = flow.frame(state)
    return state


def natural_swing(flow: CylinderFlow, state: np.ndarray) -> float:
    """Largest |v| behind a cylinder at rest over the frames after `state` [U]."""
    largest = 0.0
    for _ in range(_SWINGING):
        state = flow.frame(state)
        largest = max(largest, abs(flow.probe(state)))
    return largest
