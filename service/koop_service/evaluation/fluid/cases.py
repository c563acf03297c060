"""What is evaluated: the wake at rest and under a turning cylinder, at several Reynolds numbers.

A cylinder turns as training's do, by random schedules and the reference controller, and by the one
long chirp of Morton et al. ([6]), which is the paper's forcing.

A test set is one long trajectory, cut into sequences that begin `stride` frames apart and overlap,
as the paper's do. Its seed is none of training's. At another Reynolds number than training's only
sequences that share no frame are taken.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from koop_service.evaluation.systems import Baseline, System

FIT_FRAMES = 16
UPDATE_AT = 40
"""The single update is a fit on so many frames."""
AHEAD = 100
"""Frames after the fit: the paper's 15 s."""
TRAINED, HELD_OUT = 50.0, (45.0, 60.0)
"""Reynolds numbers of the training set, and of others."""
SEQUENCES = 120
"""As many as the paper's."""


@dataclass(frozen=True)
class Wake:
    """One model's flow; `plant` are the options that make koop-dataset simulate it.

    `held_out` says whether it is judged at Reynolds numbers that training has not seen, too.
    """

    name: str
    title: str
    model: str
    plant: tuple[str, ...]
    stride: int
    baseline: Baseline
    held_out: bool = True

    @property
    def actuated(self) -> bool:
        """Whether the cylinder turns."""
        return "--actuated" in self.plant


_TURNING = ("--system", "cylinder", "--actuated", "--rotation")

# Strides are no multiples of the shedding period (8.9 frames), so that all phases are met. The
# natural wake shows nothing new after a few periods; a schedule does, and the chirp to its end.
WAKES = {
    wake.name: wake
    for wake in (
        Wake("cylinder", "natural wake", "cylinder", ("--system", "cylinder"), 7, "learned-A"),
        Wake(
            "cylinder-actuated",
            "turning at random",
            "cylinder-actuated",
            (*_TURNING, "mix"),
            24,
            "learned-B",
        ),
        Wake(
            "cylinder-chirp",
            "turning by the chirp of [6]",
            "cylinder-actuated",
            (*_TURNING, "chirp"),
            41,
            "learned-B",
            held_out=False,
        ),
    )
}


@dataclass(frozen=True)
class Case:
    """Sequences of `length` frames from `starts` of a trajectory of `frames`, of one wake."""

    wake: Wake
    reynolds: float
    frames: int
    starts: tuple[int, ...]
    length: int = FIT_FRAMES + AHEAD

    @property
    def held_out(self) -> bool:
        """Whether training has not seen this Reynolds number."""
        return self.reynolds != TRAINED

    @property
    def system(self) -> System:
        """What koop-dataset is asked for, and whose weights are judged."""
        reynolds = ("--reynolds", f"{self.reynolds:g}") if self.held_out else ()
        wake = self.wake
        plant = (*wake.plant, *reynolds)
        return System(
            wake.model, wake.title, plant, FIT_FRAMES, self.frames, baseline=wake.baseline
        )


def cases(wake: Wake, sequences: int, held_out: Sequence[float]) -> Iterator[Case]:
    """The trained Reynolds number, then the others, if any, on trajectories of the same length."""
    starts = tuple(wake.stride * i for i in range(sequences))
    frames = starts[-1] + FIT_FRAMES + AHEAD
    yield Case(wake, TRAINED, frames, starts)
    for reynolds in held_out if wake.held_out else ():
        yield Case(wake, reynolds, frames, starts[:: apart(wake)])


def apart(wake: Wake) -> int:
    """Of the sequences in turn, each so-many-th shares no frame with the one before."""
    return math.ceil((FIT_FRAMES + AHEAD) / wake.stride)


def chosen(names: tuple[str, ...]) -> list[Wake]:
    """The wakes of these names; "all", or none, is every one. ValueError for an unknown name."""
    for name in names:
        if name not in WAKES and name != "all":
            raise ValueError(f"unknown system {name!r}; there are all, {', '.join(WAKES)}")
    everything = not names or "all" in names
    return [wake for wake in WAKES.values() if everything or wake.name in names]
