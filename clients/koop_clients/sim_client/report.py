"""What a run found, as a value, as text and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.sim_client.driving.drive import Drive
from koop_clients.sim_client.driving.driver import Account
from koop_clients.sim_client.driving.outcome import Outcome
from koop_clients.sim_client.scoring import Errors


@dataclass(frozen=True)
class Latency:
    """How long answers took [s]."""

    count: int
    p50: float
    p99: float


def latency(seconds: Sequence[float]) -> Latency | None:
    """Quantiles; None where there was none."""
    if not seconds:
        return None
    p50, p99 = np.quantile(np.asarray(seconds), [0.5, 0.99])
    return Latency(len(seconds), float(p50), float(p99))


@dataclass(frozen=True)
class Driven:
    """The drive of one plant.

    Attributes:
        trajectory: its name.
        start: angle near which it was to begin [rad].
        target: angle to reach [rad].
        began: simulated time at which it did [s]; None where it was not driven.
        seconds: how long it was driven [s].
        outcome: what became of the pole.
        command: from a frame being put to its command being there.
        late: intervals that were over before their own command came.
        statuses: commands by the solver's word.
        delay: frames between a frame and its first control, as the service was told.
        reasons: why the model was last found not fit for control.
        warnings: what the service said beside its first plan.
    """

    trajectory: str
    start: float
    target: float
    began: float | None
    seconds: float
    outcome: Outcome | None
    command: Latency | None
    late: int
    statuses: dict[str, int]
    delay: int
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Totals:
    """All drives of a run.

    Attributes:
        plants: how many were to be driven.
        driven: how many were.
        successes: how many reached the target and held it.
        success_rate: of all plants, those never driven included.
        cost: mean over those driven.
        command: from a frame being put to its command being there, over all plants.
        late: intervals that were over before their own command came.
    """

    plants: int
    driven: int
    successes: int
    success_rate: float
    cost: float | None
    command: Latency | None
    late: int


def driven(drive: Drive) -> Driven:
    """What is told of one drive."""
    account, began = drive.driver.account, drive.began
    return Driven(
        trajectory=drive.trajectory,
        start=drive.start,
        target=drive.course.target,
        began=None if began is None else began * FRAME_INTERVAL,
        seconds=len(drive.log.angles) * FRAME_INTERVAL,
        outcome=drive.outcome(),
        command=latency(account.latencies),
        late=account.late,
        statuses=dict(account.statuses),
        delay=account.delay,
        reasons=account.reasons,
        warnings=account.warnings,
    )


def totals(drives: Sequence[Driven], accounts: Sequence[Account]) -> Totals | None:
    """All drives together; None where there is none."""
    if not drives:
        return None
    outcomes = [drive.outcome for drive in drives if drive.outcome is not None]
    successes = sum(outcome.success for outcome in outcomes)
    return Totals(
        plants=len(drives),
        driven=len(outcomes),
        successes=successes,
        success_rate=successes / len(drives),
        cost=float(np.mean([outcome.cost for outcome in outcomes])) if outcomes else None,
        command=latency([seconds for account in accounts for seconds in account.latencies]),
        late=sum(account.late for account in accounts),
    )


@dataclass(frozen=True)
class Result:
    """One run of `koop-sim-client`.

    Attributes:
        system: its name.
        drive: what drove it.
        trajectories: plants streamed at once.
        frames: frames put, over all plants.
        simulated: time simulated [s].
        elapsed: time on the wall [s].
        early: errors of the first predictions answered.
        late: errors of the last ones.
        others: errors of the last ones of the other plants.
        predict: round trips of predictions.
        refused: questions without an answer (warming up not counted).
        drives: what became of each plant.
        totals: and of all of them.
        completed: False where it was stopped before its time.
    """

    system: str
    drive: str
    trajectories: int
    frames: int
    simulated: float
    elapsed: float
    early: Errors | None
    late: Errors | None
    others: Errors | None
    predict: Latency | None
    refused: int
    drives: list[Driven]
    totals: Totals | None
    completed: bool

    @property
    def frames_per_s(self) -> float:
        """Frames put for each second on the wall."""
        return self.frames / self.elapsed if self.elapsed else 0.0

    @property
    def refusal(self) -> str:
        """Why the service drove no plant at all, if it was asked and had reasons; else ""."""
        if self.totals is None or self.totals.driven:
            return ""
        return "; ".join(dict.fromkeys(why for drive in self.drives for why in drive.reasons))

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
        rows = {
            "first predictions": self.early,
            "last predictions": self.late,
            "the other plants": self.others,
        }
        lines += error_lines("RMSE per pixel after ", rows, FRAME_INTERVAL)
        lines += _latency_lines(self)
        lines += _drive_lines(self)
        return "\n".join(lines)


def error_lines(heading: str, rows: Mapping[str, Errors | None], interval: float) -> list[str]:
    """A table of errors under their times ahead, `interval` [s] from frame to frame."""
    known = {name: errors for name, errors in rows.items() if errors is not None}
    if not known:
        return ["no prediction could be compared with what happened"]
    horizons = next(iter(known.values())).horizons
    lines = [f"\n{heading:<21}" + "".join(f"{h * interval:>8g} s" for h in horizons)]
    for name, errors in known.items():
        lines.append(f"  {name:<19}" + _cells(errors.error))
        lines.append(f"  {'  repeating a frame':<19}" + _cells(errors.repeat))
    return lines


def _cells(values: Sequence[float]) -> str:
    return "".join(f"{value:10.4f}" for value in values)


def _latency_lines(result: Result) -> list[str]:
    lines = []
    found = {
        "round trip of a prediction": result.predict,
        "frame put to command there": result.totals.command if result.totals else None,
    }
    for name, values in found.items():
        if values is not None:
            lines.append(
                f"{name}: {1000 * values.p50:.1f} ms (p50), {1000 * values.p99:.1f} ms (p99) "
                f"over {values.count}"
            )
    if result.refused:
        lines.append(f"predictions without an answer: {result.refused}")
    return ["", *lines] if lines else []


def _drive_lines(result: Result) -> list[str]:
    if result.totals is None:
        return []
    if len(result.drives) == 1:
        return _one_drive(result.drives[0])
    found = result.totals
    lines = [
        f"\ndrive: {found.successes} of {found.plants} reached and held the target"
        + (f", mean cost {found.cost:.2f}" if found.cost is not None else "")
    ]
    if missing := found.plants - found.driven:
        lines.append(f"  {missing} never driven")
    if found.late:
        lines.append(f"  {found.late} commands came after their interval was over")
    return lines


def _one_drive(drive: Driven) -> list[str]:
    found = drive.outcome
    if found is None:
        return [f"\ndrive: NEVER BEGAN {'; '.join(drive.reasons)}".rstrip()]
    settled = (
        "never settled there"
        if found.settled_after is None
        else f"within 0.1 rad for good after {found.settled_after:.2f} s"
    )
    lines = [
        f"\ndrive: {'reached and held the target' if found.success else 'DID NOT hold the target'}",
        f"  {settled}, with at most {found.largest_torque:.1f} N m, cost {found.cost:.2f}",
        f"  {found.worst_error_at_end:.3f} rad off at worst in the last 2 s, "
        f"{found.final_error:.3f} rad at the end",
    ]
    if drive.late:
        lines.append(f"  {drive.late} commands came after their interval was over")
    return lines + [f"  the service says: {text}" for text in drive.warnings]
