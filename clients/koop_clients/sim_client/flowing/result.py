"""What a run of flows found, as a value, as text and as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from koop_clients.flow.settings import FRAME_INTERVAL
from koop_clients.sim_client.flowing.drive import FlowDrive
from koop_clients.sim_client.flowing.outcome import CALM, FlowOutcome
from koop_clients.sim_client.report import Latency, error_lines, latency
from koop_clients.sim_client.scoring import Errors


@dataclass(frozen=True)
class FlowDriven:
    """The drive of one wake.

    Attributes:
        began: number of the first frame driven; None where it was not.
        outcome: what became of the wake.
        command: from a frame being put to its command being there.
        late: intervals that were over before their own command came.
        statuses: commands by the solver's word.
        reasons: why the model was last found not fit for control.
        warnings: what the service said beside its first plan.
    """

    began: int | None
    outcome: FlowOutcome | None
    command: Latency | None
    late: int
    statuses: dict[str, int]
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]


def driven(drive: FlowDrive) -> FlowDriven:
    """What is told of one drive."""
    account = drive.driver.account
    return FlowDriven(
        began=drive.began,
        outcome=drive.outcome(),
        command=latency(account.latencies),
        late=account.late,
        statuses=dict(account.statuses),
        reasons=account.reasons,
        warnings=account.warnings,
    )


@dataclass(frozen=True)
class FlowResult:
    """What was streamed.

    Attributes:
        system: its name.
        drive: what drove it.
        trajectories: flows streamed at once.
        frames: frames put, over all flows.
        simulated: time simulated [s], 0.15 s a frame.
        elapsed: time on the wall [s].
        frame: what a frame took to simulate [s].
        early: errors of the first predictions answered, in units of the channels' natural spread.
        late: errors of the last ones.
        predict: round trips of predictions.
        swing: largest |v| behind the cylinder in the last 20 frames of the first flow [U].
        drives: what became of each flow that was to be driven.
        completed: False where it was stopped before its time.
    """

    system: str
    drive: str
    trajectories: int
    frames: int
    simulated: float
    elapsed: float
    frame: Latency | None
    early: Errors | None
    late: Errors | None
    predict: Latency | None
    swing: float
    drives: list[FlowDriven]
    completed: bool

    @property
    def frames_per_s(self) -> float:
        """Frames put for each second on the wall."""
        return self.frames / self.elapsed if self.elapsed else 0.0

    @property
    def refusal(self) -> str:
        """Why the service drove no flow at all, if it was asked and had reasons; else ""."""
        if any(drive.outcome is not None for drive in self.drives):
            return ""
        return "; ".join(dict.fromkeys(why for drive in self.drives for why in drive.reasons))

    def to_json(self) -> str:
        """One line; seconds and U."""
        return json.dumps({**asdict(self), "frames_per_s": self.frames_per_s})

    def to_text(self) -> str:
        """For a reader."""
        flows = f" of {self.trajectories} flows" if self.trajectories > 1 else ""
        lines = [
            f"streamed {self.frames} frames{flows} in {self.elapsed:.1f} s "
            f"({self.frames_per_s:.1f} frames/s), {self.simulated:.1f} s simulated",
            f"behind the cylinder the flow swings by {self.swing:.3g} U",
        ]
        if self.frame is not None:
            lines.append(f"a frame took {_quantiles(self.frame)} to simulate")
        rows = {"first predictions": self.early, "last predictions": self.late}
        lines += error_lines("RMSE per value after ", rows, FRAME_INTERVAL)
        if self.predict is not None:
            lines.append(f"\nround trip of a prediction: {_quantiles(self.predict)}")
        for drive in self.drives:
            lines += _drive_lines(drive)
        return "\n".join(lines)


def _drive_lines(drive: FlowDriven) -> list[str]:
    found = drive.outcome
    if found is None:
        return [f"\ndrive: NEVER BEGAN {'; '.join(drive.reasons)}".rstrip()]
    calmed = "never calm"
    if found.calmed_after is not None:
        calmed = f"below {100 * CALM:g}% of its natural swing for good after "
        calmed += f"{found.calmed_after} frames"
    lines = [
        f"\ndrive: {'calmed the wake' if found.success else 'DID NOT calm the wake in time'}",
        f"  {calmed}, with at most {found.largest_rotation:.2f} U/D",
        f"  it swings by {found.swing_at_end:.2g} U at the end, {found.natural:.2g} U by nature",
    ]
    if drive.command is not None:
        lines.append(f"  from a frame to its command: {_quantiles(drive.command)}")
    if drive.late:
        lines.append(f"  {drive.late} commands came after their interval was over")
    return lines + [f"  the service says: {text}" for text in drive.warnings]


def _quantiles(values: Latency) -> str:
    return f"{1000 * values.p50:.1f} ms (p50), {1000 * values.p99:.1f} ms (p99)"
