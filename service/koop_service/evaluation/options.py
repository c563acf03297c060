"""The options that koop-eval's subcommands share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from koop_service.encoding.catalogue import bundled_folder
from koop_service.evaluation.datasets import cache_folder
from koop_service.evaluation.systems import FIRST_TEST_SEED


@dataclass(frozen=True, kw_only=True)
class Options:
    """What every subcommand is told."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/eval")
    """Folder for the figures, the tables and report.md."""
    weights: Path = field(default_factory=bundled_folder)
    """Folder of the weights, with the training logs (.csv), and those in `baselines`, `sizes`."""
    threads: int = 1
    """Threads that run the network; on a busy machine more than one are many times slower."""
    json: bool = False
    """Print one JSON object on the last line."""

    def check(self) -> None:
        """Raise ValueError for a value that makes no sense."""
        at_least_one("threads", self.threads)


@dataclass(frozen=True, kw_only=True)
class TestSetOptions(Options):
    """What a subcommand is told that judges models by their test sets."""

    __test__ = False  # for pytest, which takes the name for a test's

    trajectories: int = 100
    """Test trajectories of each system."""
    data: Path = field(default_factory=cache_folder)
    """Folder that keeps the test sets."""
    seed: int = FIRST_TEST_SEED
    """Seed of the test sets, from 1000 up: lower ones are for training."""

    def check(self) -> None:
        super().check()
        at_least_one("trajectories", self.trajectories)


def at_least_one(name: str, value: int) -> None:
    """Raise ValueError where the option `name` is none."""
    if value < 1:
        raise ValueError(f"--{name} is {value}; expected 1 or more")
