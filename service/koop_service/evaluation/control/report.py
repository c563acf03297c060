"""The page about control: tables, figures, and how they were got; all words made of the numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from koop_service.evaluation.control.methods import METHODS, REFERENCE
from koop_service.evaluation.control.plants import Plant
from koop_service.evaluation.control.study import (
    CHANGE_TARGET,
    RECOVERY,
    Change,
    OpenLoop,
)
from koop_service.evaluation.control.trials import DRIVE, LEARN, STARTS, Protocol, Trials
from koop_service.evaluation.report import table

COLUMNS = ("plant", "method", "starts", "success", "cost", "cost ratio", "p50 ms", "p99 ms", "late")


_CHANGE = (
    f"The gain holds the pole at {CHANGE_TARGET:g} rad, where that takes a torque, and its mass "
    "changes: the online model learns what it is now, the frozen one stays as it was at takeover."
)


@dataclass(frozen=True, eq=False)
class Judged:
    """What was found of one plant; dt: between frames [s]."""

    plant: Plant
    dt: float
    trials: Mapping[str, Trials]
    change: Change
    open_loop: OpenLoop

    def ratio(self, method: str) -> float:
        """Cost over that of the reference on the starts where `method` succeeded; NaN without."""
        mine, reference = self.trials[method], self.trials[REFERENCE]
        good = mine.success & np.isfinite(reference.cost)
        return float(mine.cost[good].sum() / reference.cost[good].sum()) if good.any() else np.nan


def as_json(judged: Sequence[Judged]) -> dict[str, Any]:
    """System -> method -> success rate, cost, p99; and system -> open loop, change of mass."""
    found: dict[str, Any] = {}
    for one in judged:
        methods: dict[str, Any] = {
            name: {
                "success_rate": trials.success_rate,
                "cost": _number(trials.mean_cost),
                "cost_ratio": _number(one.ratio(name)),
                "p99": trials.p99,
            }
            for name, trials in one.trials.items()
        }
        methods["open-loop"] = {"arrival_error": float(np.median(one.open_loop.arrival))}
        methods["change-of-mass"] = {
            name: one.change.distance(name, RECOVERY, one.dt) for name in one.change.runs
        }
        found[one.plant.name] = methods
    return found


def rows(judged: Sequence[Judged]) -> list[tuple[object, ...]]:
    """What fits COLUMNS, of every plant and method."""
    return [
        (
            one.plant.name,
            name,
            len(trials.success),
            trials.success_rate,
            _number(trials.mean_cost),
            _number(one.ratio(name)),
            _milliseconds(trials.p50),
            _milliseconds(trials.p99),
            trials.late,
        )
        for one in judged
        for name, trials in one.trials.items()
    ]


def markdown(judged: Sequence[Judged], protocol: Protocol, command: str) -> str:
    """The page."""
    sections = [
        "# Control: from pictures to torques, on the simulator",
        f"Written by `{command}`; nothing on this page was typed by hand.",
        _protocol(protocol),
    ]
    for one in judged:
        sections += _plant(one)
    sections += ["## A change of mass in mid-run", _CHANGE, "![Change of mass](change-of-mass.png)"]
    sections += [_change(one) for one in judged]
    return "\n\n".join(sections) + "\n"


def _protocol(protocol: Protocol) -> str:
    low, high = STARTS
    return (
        f"A simulated camera streams 20 pictures a second to `koop-serve` through Zenoh. For "
        f"{LEARN:g} s the plant is excited, first around hanging, then around the target, and the "
        f"service learns; then the service's commands move it for {DRIVE:g} s, from starts drawn "
        f"evenly between {low:g} and {high:g} rad from upright (seed {protocol.seed}), "
        f"{protocol.together} plants at a time, in real time. Success: within 0.1 rad of the "
        "target and no faster than 0.5 rad/s all through the last 2 s. Cost: the sum over the "
        "frames of error² + 0.1 rate² + 0.001 torque²; its ratio to that of the true state's LQR "
        "is over the starts on which the method succeeded. Latency: from a frame being put to its "
        "command being there, in the client, of the slowest batch."
    )


def _plant(one: Judged) -> list[str]:
    name, open_loop = one.plant.name, one.open_loop
    head = ("method", "success", "cost", "over LQR, true state", "p50", "p99", "late")
    cells = [
        (
            METHODS[method].title,
            f"{trials.success.sum()} of {len(trials.success)}",
            _two(trials.mean_cost),
            _two(one.ratio(method)),
            "" if trials.p50 is None or _waits(method) else f"{1000 * trials.p50:.1f} ms",
            "" if trials.p99 is None or _waits(method) else f"{1000 * trials.p99:.1f} ms",
            str(trials.late),
        )
        for method, trials in one.trials.items()
    ]
    steps = len(open_loop.planned)
    arrival = np.quantile(open_loop.arrival, (0.5, 0.9))
    return [
        f"## {one.plant.system.title[:1].upper()}{one.plant.system.title[1:]}",
        table(head, cells),
        f"![Every start]({name}-ways.png)",
        f"### Figure {one.plant.figure}: the plan, and what came of it",
        f"As in the paper, one plan over {steps * one.dt:g} s is followed without a further look. "
        f"At its end the pole is {arrival[0]:.2f} rad from upright in the median over "
        f"{len(open_loop.arrival)} starts, {arrival[1]:.2f} rad at the 90th percentile.",
        f"![Figure {one.plant.figure}](figure-{one.plant.figure:02}.png)",
        "### A drive in closed loop",
        f"![Closed loop]({name}-film.gif)",
    ]


def _change(one: Judged) -> str:
    change, dt = one.change, one.dt
    online, frozen = (change.distance(name, RECOVERY, dt) for name in ("online", "frozen"))
    return (
        f"- {one.plant.system.title}, held at {CHANGE_TARGET:g} rad, mass times "
        f"{change.factor:g}: {RECOVERY:g} s later the online model's distance is {online:.3f} rad "
        f"({change.before('online', dt):.3f} before), the frozen one's {frozen:.3f} rad "
        f"({change.before('frozen', dt):.3f} before), {frozen / online:.1f} times as much."
    )


def _waits(method: str) -> bool:
    return not METHODS[method].timed


def _two(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else ""


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _milliseconds(seconds: float | None) -> float | None:
    return None if seconds is None else 1000 * seconds
