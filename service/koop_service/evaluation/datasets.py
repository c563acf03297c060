"""Test sets: made by koop-dataset, a command of the clients, and kept for the next time."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from koop_protocol import recording as names
from koop_service.evaluation.programs import find_program
from koop_service.evaluation.systems import FIRST_TEST_SEED, System
from koop_service.learning.recording import Recording, load_recording


@dataclass(frozen=True, eq=False)
class TestSet:
    """A recording and the simulator's true states (N, T, 2 nv): configuration, then velocity."""

    __test__ = False  # for pytest, which takes the name for a test's

    recording: Recording
    states: np.ndarray


def cache_folder() -> Path:
    """Where test sets are kept unless told otherwise."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "koop" / "test-sets"


def options(system: System, trajectories: int, seed: int) -> list[str]:
    """The options of koop-dataset that make a test set.

    Raises ValueError for a seed that a training set may have.
    """
    if seed < FIRST_TEST_SEED:
        raise ValueError(
            f"--seed is {seed}; test seeds start at {FIRST_TEST_SEED}: lower ones are for training"
        )
    counts = {"--trajectories": trajectories, "--frames": system.frames, "--seed": seed}
    return [*system.plant, *(str(part) for pair in counts.items() for part in pair)]


def test_set(system: System, trajectories: int, seed: int, folder: Path) -> TestSet:
    """The test set of a system, made if `folder` has none of just these options."""
    path = made(system, trajectories, seed, folder)
    recording = load_recording(path)
    with h5py.File(path, "r") as file:
        states: Any = file[names.STATES_DATASET]
        return TestSet(recording, states[:])


def made(system: System, trajectories: int, seed: int, folder: Path) -> Path:
    """The file of a test set, made if `folder` has none of just these options."""
    path = kept_at(system, trajectories, seed, folder)
    if not path.exists():
        _make(path, options(system, trajectories, seed))
    return path


def kept_at(system: System, trajectories: int, seed: int, folder: Path) -> Path:
    """Where in `folder` a test set is kept, by all its options."""
    wanted = " ".join(options(system, trajectories, seed))
    digest = hashlib.blake2b(wanted.encode(), digest_size=6).hexdigest()
    return folder / f"{system.name}-{digest}.h5"


def _make(path: Path, wanted: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    command = [find_program("koop-dataset"), *wanted, "--out", str(path)]
    print(f"koop-eval: koop-dataset {' '.join(command[1:])}", file=sys.stderr)
    code = subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
    if code:
        raise ValueError(f"koop-dataset failed with exit code {code}; its message is above")
