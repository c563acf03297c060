"""Several wakes of one method, by koop-sim-client: what became of each."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koop_service.evaluation.control.trials import Array
from koop_service.evaluation.programs import find_program

INTERVAL = 0.15
"""From frame to frame by the paper's label [s]."""
LEARN, DRIVE = 160, 280
"""Frames under a random schedule, and of the drive."""
PROMPT, CALM = 150, 0.1
"""Frames within which the wake is to be calm, and the share of its natural swing that is."""
LAST = 20
"""Frames at the end, a good two periods."""


@dataclass(frozen=True)
class Protocol:
    """How many wakes, their seed, and koop-sim-client's rate."""

    wakes: int = 5
    seed: int = 2000
    rate: str = "max"


@dataclass(frozen=True, eq=False)
class Trials:
    """All wakes of one method.

    probes, rotations (N, T): v behind the cylinder [U] at each frame of the drive, and the rotation
    after it [U/D]; NaN of one that was never driven. natural: largest |v| by nature [U]. momenta
    (T, H, W): along the stream, of the first wake, over the free stream's; target (H, W).
    p50, p99: frame put to command there [s]; None where nobody commands.
    """

    probes: Array
    rotations: Array
    natural: float
    momenta: np.ndarray
    target: np.ndarray
    calmed: Sequence[int | None]
    success: Sequence[bool]
    p50: float | None
    p99: float | None

    @property
    def late_swing(self) -> Array:
        """(N,) largest |v| from the 150th frame on, over the natural swing."""
        return self._largest(self.probes[:, PROMPT:])

    @property
    def last_swing(self) -> Array:
        """(N,) largest |v| in the last frames, over the natural swing."""
        return self._largest(self.probes[:, -LAST:])

    def _largest(self, probes: Array) -> Array:
        """Over the natural swing, which is that of a wake that was never driven."""
        swings = np.nanmax(np.abs(probes), axis=1, initial=0) / self.natural
        return np.where(np.isnan(self.probes).all(axis=1), 1.0, swings)

    @property
    def effort(self) -> Array:
        """(N,) root mean square of the rotation over the drive [U/D]; 0 where there was none."""
        driven = np.maximum(np.isfinite(self.rotations).sum(axis=1), 1)
        return np.sqrt(np.nansum(self.rotations**2, axis=1) / driven)

    @property
    def largest(self) -> float:
        """The largest rotation of all drives [U/D]."""
        return float(np.nanmax(np.abs(self.rotations), initial=0))

    def swings(self) -> Array:
        """(N, T) largest |v| within a period around each frame, over the natural swing."""
        padded = np.pad(np.abs(self.probes), ((0, 0), (4, 4)), constant_values=0)
        windows = np.lib.stride_tricks.sliding_window_view(padded, 9, axis=1)
        return windows.max(axis=2) / self.natural


def run(options: Sequence[str], endpoint: str, protocol: Protocol) -> Trials:
    """Drive every wake; `options` are koop-sim-client's."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "drives.npz"
        told = _simulate(options, endpoint, protocol, record)
        with np.load(record) as saved:
            return told_of(told, {name: saved[name] for name in saved.files})


def _simulate(
    options: Sequence[str], endpoint: str, protocol: Protocol, record: Path
) -> Mapping[str, Any]:
    numbers = {
        "--system": "cylinder",
        "--trajectories": protocol.wakes,
        "--seed": protocol.seed,
        "--rate": protocol.rate,
        "--learn": LEARN * INTERVAL,
        "--duration": (LEARN + DRIVE) * INTERVAL,
        "--ask-every": 1e6,  # predictions are judged elsewhere
        "--record": record,
        "--connect": endpoint,
    }
    chosen = [str(part) for pair in numbers.items() for part in pair]
    command = [find_program("koop-sim-client"), *chosen, *options, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    # It fails where the service drove no wake at all, too: that is an outcome.
    if not done.stdout.startswith("{"):
        raise ValueError(f"koop-sim-client failed: {done.stderr.strip()[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def told_of(told: Mapping[str, Any], saved: Mapping[str, np.ndarray]) -> Trials:
    """The trials, of koop-sim-client's answer and its record."""
    outcomes = [drive["outcome"] for drive in told["drives"]]
    commands = [drive["command"] for drive in told["drives"] if drive["command"]]
    # Where not one was driven, there is no frame at all.
    none = np.full((len(outcomes), 0 if saved["probes"].size else DRIVE), np.nan)
    return Trials(
        probes=np.concatenate([saved["probes"], none], axis=1),
        rotations=np.concatenate([saved["rotations"], none], axis=1),
        natural=float(saved["natural"]),
        momenta=saved["momenta"],
        target=saved["target"],
        calmed=[found["calmed_after"] if found else None for found in outcomes],
        success=[bool(found and found["success"]) for found in outcomes],
        p50=max((c["p50"] for c in commands), default=None),
        p99=max((c["p99"] for c in commands), default=None),
    )
