"""What is evaluated: the paper's seven sets (sections 3.2, 3.3, A.2), each with its test set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Baseline = Literal["learned-A", "learned-B"]

FIRST_TEST_SEED = 1000
"""Training sets have lower seeds, so that no test trajectory was ever trained on."""

HORIZONS = (0.05, 1.0, 5.0, 15.0)
"""Times after the fit that the tables report [s]."""


@dataclass(frozen=True)
class System:
    """One set of the paper.

    `plant` are the options that make koop-dataset simulate it. Theta is fitted on the first
    `fit_frames` of `frames`; partial updates come every `partial_every` frames. `reads_angle`: the
    picture shows one pole about its centre.
    """

    name: str
    title: str
    plant: tuple[str, ...]
    fit_frames: int = 80
    frames: int = 380
    partial_every: int = 15
    baseline: Baseline | None = None
    reads_angle: bool = False

    @property
    def actuated(self) -> bool:
        """Whether controls act on it."""
        return "--actuated" in self.plant


_PAPER_TRACKING = ("--actuated", "--excitation", "paper")

SYSTEMS = {
    system.name: system
    for system in (
        System(
            "pendulum-low",
            "pendulum, low amplitude, lengths 0.3 to 0.8 m",
            ("--system", "pendulum", "--vary"),
            baseline="learned-A",
            reads_angle=True,
        ),
        System(
            "pendulum-high",
            "pendulum, high amplitude, lengths 0.3 to 0.8 m",
            ("--system", "pendulum", "--vary", "--high"),
            reads_angle=True,
        ),
        System(
            "pendulum-fixed",
            "pendulum, length 0.6 m",
            ("--system", "pendulum"),
            baseline="learned-A",
            reads_angle=True,
        ),
        System(
            "double-pendulum",
            "double pendulum, masses and lengths vary",
            ("--system", "double-pendulum", "--vary"),
        ),
        # The paper updates the cartpole every frame in figure 3; that is the full regime here.
        System(
            "cartpole",
            "cartpole, masses and lengths vary",
            ("--system", "cartpole", "--vary"),
        ),
        System(
            "pendulum-actuated",
            "actuated pendulum",
            ("--system", "pendulum", *_PAPER_TRACKING),
            fit_frames=100,
            frames=400,
            baseline="learned-B",
            reads_angle=True,
        ),
        System(
            "cartpole-actuated",
            "actuated cartpole",
            ("--system", "cartpole", *_PAPER_TRACKING),
            fit_frames=100,
            frames=400,
            baseline="learned-B",
        ),
    )
}


def chosen(names: tuple[str, ...]) -> list[System]:
    """The systems of these names, in the table's order; "all", or none, is every one.

    Raises ValueError for a name that is not in the table.
    """
    for name in names:
        if name not in SYSTEMS and name != "all":
            raise ValueError(f"unknown system {name!r}; there are all, {', '.join(SYSTEMS)}")
    everything = not names or "all" in names
    return [s for s in SYSTEMS.values() if everything or s.name in names]
