"""What a run found, as a value, as text and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.sim_client.outcome import Outcome
from koop_clients.sim_client.scoring import Errors


@dataclass(frozen=True)
class Latency:
    """Round trips of queries [s]."""

    count: int
    p50: float
    p99: float


def latency(seconds: Sequence[float]) -> Latency | None:
    """Quantiles of round trips; None where there was none."""
    if not seconds:
        return None
    p50, p99 = np.quantile(np.asarray(seconds), [0.5, 0.99])
    return Latency(len(seconds), float(p50), float(p99))


@dataclass(frozen=True)
class Result:
    """One run of `koop-sim-client`.

    Attributes:
        system: its name.
        trajectories: plants streamed at once.
        frames: frames put, over all plants.
        simulated: time simulated [s].
        elapsed: time on the wall [s].
        early: errors of the first predictions answered.
        late: errors of the last ones.
        others: errors of the last ones of the other plants.
        predict: round trips of predictions.
        lqr: round trips of plans.
        refused: questions without an answer (warming up not counted).
        late_plans: frames in the drive that had to follow an older plan.
        drive: what became of the pole.
        completed: False where it was stopped before its time.
    """

    system: str
    trajectories: int
    frames: int
    simulated: float
    elapsed: float
    early: Errors | None
    late: Errors | None
    others: Errors | None
    predict: Latency | None
    lqr: Latency | None
    refused: int
    late_plans: int
    drive: Outcome | None
    completed: bool

    @property
    def frames_per_s(self) -> float:
        """Frames put for each second on the wall."""
        return self.frames / self.elapsed if self.elapsed else 0.0

    def to_json(self) -> str:
        """One line; seconds, radians, N m."""
        return json.dumps({**asdict(self), "frames_per_s": self.frames_per_s})

    def to_text(self) -> str:
        """A short table for a reader."""
        plants = f" of {self.trajectories} plants" if self.trajectories > 1 else ""
        lines = [
            f"streamed {self.frames} frames{plants} in {self.elapsed:.1f} s "
            f"({self.frames_per_s:.0f} frames/s), {self.simulated:.1f} s simulated"
        ]
        lines += _error_lines(self)
        lines += _latency_lines(self)
        if self.drive is not None:
            lines += _drive_lines(self.drive)
        return "\n".join(lines)


def _error_lines(result: Result) -> list[str]:
    if result.early is None:
        return ["no prediction could be compared with what happened"]
    heading = "".join(f"{h * FRAME_INTERVAL:>8g} s" for h in result.early.horizons)
    lines = [f"\nRMSE per pixel after {heading}"]
    rows = {"first predictions": result.early, "last predictions": result.late}
    for name, errors in {**rows, "the other plants": result.others}.items():
        if errors is not None:
            lines.append(f"  {name:<19}" + _cells(errors.error))
            lines.append(f"  {'  repeating a frame':<19}" + _cells(errors.repeat))
    return lines


def _cells(values: Sequence[float]) -> str:
    return "".join(f"{value:10.4f}" for value in values)


def _latency_lines(result: Result) -> list[str]:
    lines = []
    for name, found in {"prediction": result.predict, "plan": result.lqr}.items():
        if found is not None:
            lines.append(
                f"  {name}: {1000 * found.p50:.1f} ms (p50), {1000 * found.p99:.1f} ms (p99) "
                f"over {found.count}"
            )
    if lines:
        lines.insert(0, "\nround trip of a query")
    if result.refused:
        lines.append(f"  without an answer: {result.refused}")
    return lines


def _drive_lines(drive: Outcome) -> list[str]:
    settled = (
        "never settled within 0.1 rad"
        if drive.settled_after is None
        else f"within 0.1 rad for good after {drive.settled_after:.2f} s"
    )
    return [
        f"\ndrive: {'reached and held the target' if drive.success else 'DID NOT hold the target'}",
        f"  {settled}, with at most {drive.largest_torque:.1f} N m",
        f"  {drive.worst_error_at_end:.3f} rad off at worst in the last 2 s, "
        f"{drive.final_error:.3f} rad at the end",
    ]
