"""Many starts of one method, by koop-sim-client in batches: what became of each."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koop_service.evaluation.control.plants import Plant
from koop_service.evaluation.programs import find_program

Array = NDArray[np.float64]

LEARN, DRIVE = 20.0, 8.0
"""Excitation before the drive, and the drive [s]; the last 2 s decide about success."""
STARTS = (-1.0, 1.0)
"""Angles between which the drives start, 0 being upright [rad]."""


@dataclass(frozen=True)
class Protocol:
    """How starts are run: `together` plants at a time, `seed` for starts and torques.

    `rate` is koop-sim-client's: realtime, or max, where simulated time waits for each command.
    They are drawn evenly from `between` [rad].
    """

    starts: int = 100
    together: int = 20
    seed: int = 0
    rate: str = "realtime"
    between: tuple[float, float] = STARTS

    def batches(self) -> list[tuple[int, int]]:
        """(first number, count) of each batch."""
        firsts = range(0, self.starts, self.together)
        return [(first, min(self.together, self.starts - first)) for first in firsts]


@dataclass(frozen=True, eq=False)
class Trials:
    """All starts of one method on one plant.

    success (N,); cost (N,), NaN of a plant that was never driven. angles, rates, torques (N, T):
    from the target [rad], [rad/s], [N m] at each frame of the drive. p50, p99: frame put to command
    there, of the slowest batch [s]; None where nobody commands. late: commands after their
    interval. Of the first plant: frames (T, H, W), and planned (K, H, W) where it followed a plan
    blindly.
    """

    success: NDArray[np.bool_]
    cost: Array
    angles: Array
    rates: Array
    torques: Array
    p50: float | None
    p99: float | None
    late: int
    frames: NDArray[np.uint8]
    planned: NDArray[np.uint8]

    @property
    def success_rate(self) -> float:
        return float(self.success.mean())

    @property
    def mean_cost(self) -> float:
        """Of the starts that were driven."""
        return float(np.nanmean(self.cost)) if np.isfinite(self.cost).any() else float("nan")


def run(
    plant: Plant,
    options: Sequence[str],
    endpoint: str,
    protocol: Protocol,
    target: float = 0,
) -> Trials:
    """Drive `plant` to the angle `target` from every start; `options` are koop-sim-client's."""
    found = [
        _batch(plant, options, endpoint, protocol, target, first, count)
        for first, count in protocol.batches()
    ]
    return _join(found, target)


@dataclass(frozen=True, eq=False)
class _Batch:
    """One run of the client: its JSON, and what it recorded."""

    told: Mapping[str, Any]
    drives: Array
    frames: NDArray[np.uint8]
    planned: NDArray[np.uint8]


def _batch(
    plant: Plant,
    options: Sequence[str],
    endpoint: str,
    protocol: Protocol,
    target: float,
    first: int,
    count: int,
) -> _Batch:
    low, high = protocol.between
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "drives.npz"
        numbers = {
            "--system": plant.simulated,
            "--trajectories": count,
            "--first": first,
            "--seed": protocol.seed,
            "--rate": protocol.rate,
            "--learn": LEARN,
            "--duration": LEARN + DRIVE,
            "--target": target or "upright",
            "--ask-every": 1e6,  # predictions are judged elsewhere
            "--record": record,
            "--connect": endpoint,
        }
        chosen = [str(part) for pair in numbers.items() for part in pair]
        starts = ["--starts", str(low), str(high)]
        command = [find_program("koop-sim-client"), *chosen, *starts, *options, "--json"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        # It fails where the service drove no plant at all, too: that is an outcome.
        if not done.stdout.startswith("{"):
            raise ValueError(f"koop-sim-client failed: {done.stderr.strip()[-2000:]}")
        with np.load(record) as saved:
            return _Batch(
                json.loads(done.stdout.splitlines()[-1]),
                saved["drives"],
                saved["drive_frames"],
                saved["planned"],
            )


def _join(batches: Sequence[_Batch], target: float) -> Trials:
    told = [drive for batch in batches for drive in batch.told["drives"]]
    outcomes = [drive["outcome"] for drive in told]
    drives = _stacked([batch.drives for batch in batches])
    commands = [batch.told["totals"]["command"] for batch in batches]
    return Trials(
        success=np.array([bool(o and o["success"]) for o in outcomes]),
        cost=np.array([o["cost"] if o else np.nan for o in outcomes]),
        angles=(drives[:, :, 0] - target + np.pi) % (2 * np.pi) - np.pi,
        rates=drives[:, :, 1],
        torques=drives[:, :, 2],
        p50=max((c["p50"] for c in commands if c), default=None),
        p99=max((c["p99"] for c in commands if c), default=None),
        late=sum(batch.told["totals"]["late"] for batch in batches),
        frames=batches[0].frames,
        planned=batches[0].planned,
    )


def _stacked(parts: Sequence[Array]) -> Array:
    """Arrays (n_i, T_i, 3) as one (N, T, 3), the shorter ones filled up with NaN."""
    longest = max(part.shape[1] for part in parts)
    fill = [((0, 0), (0, longest - part.shape[1]), (0, 0)) for part in parts]
    padded = [
        np.pad(part, width, constant_values=np.nan) for part, width in zip(parts, fill, strict=True)
    ]
    return np.concatenate(padded)
