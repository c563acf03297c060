"""`koop-eval fluid`: judges predictions of the flow past a cylinder, draws and reports."""

from __future__ import annotations

import json
import shlex
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from koop_service.evaluation.datasets import made
from koop_service.evaluation.fluid.assessment import Judged, assess
from koop_service.evaluation.fluid.cases import (
    HELD_OUT,
    SEQUENCES,
    TRAINED,
    Case,
    Wake,
    cases,
    chosen,
)
from koop_service.evaluation.fluid.curves import draw_curves, draw_held_out
from koop_service.evaluation.fluid.report import Report
from koop_service.evaluation.fluid.sequences import load_sequences
from koop_service.evaluation.fluid.strips import draw_strip
from koop_service.evaluation.fluid.table import (
    APART,
    OVERLAPPING,
    Results,
    Splits,
    as_json,
    by_reynolds,
    write_csv,
)
from koop_service.evaluation.options import TestSetOptions
from koop_service.evaluation.trained import MissingWeightsError, Trained, load

_SUMMARY = ("offline", "once", "full", "repeat-last")


@dataclass(frozen=True)
class Fluid(TestSetOptions):
    """Predict the flow past a cylinder: the paper's figures 14 and 15, a table and a report.

    The JSON object holds system, split, method, horizon in seconds (by the paper's label): L1.
    """

    system: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """cylinder, cylinder-actuated or cylinder-chirp; "all", or none, is every one."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = field(
        default=Path("out/fluid"), kw_only=True
    )
    """Folder for the figures, table.csv and report.md."""
    trajectories: int = field(default=SEQUENCES, kw_only=True)
    """Test sequences of each system."""
    held_out: tuple[float, ...] = HELD_OUT
    """Reynolds numbers that training has not seen, to be judged too."""

    def check(self) -> None:
        super().check()
        if TRAINED in self.held_out:
            raise ValueError(
                f"--held-out {TRAINED:g} is the Reynolds number that was trained on; give others"
            )


def run(arguments: Fluid) -> None:
    """Judge each wake, draw, and write table and report."""
    notes: list[str] = []
    results: dict[str, Splits] = {}
    for wake in chosen(arguments.system):
        trained = _load(arguments, wake, notes)
        if trained is not None:
            results[wake.name] = _judge(wake, trained, arguments)
    if not results:
        raise ValueError(f"nothing to evaluate: {arguments.weights} holds no model of the flow")
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_csv(results, arguments.out / "table.csv")
    count = _draw(results, arguments.out)
    page = Report(results, _command(arguments), notes).markdown()
    (arguments.out / "report.md").write_text(page, encoding="utf-8")
    print(f"wrote {arguments.out / 'report.md'}, table.csv and {count} figures")
    if arguments.json:
        print(json.dumps(as_json(results)))


def _load(arguments: Fluid, wake: Wake, notes: list[str]) -> Trained | None:
    """The models of a wake, or None; what is missing goes to `notes`."""
    case = next(cases(wake, arguments.trajectories, ()))
    try:
        trained, missing = load(arguments.weights, case.system)
    except MissingWeightsError as error:
        trained, missing = None, [f"{wake.name} skipped: {error}"]
    new = [note for note in missing if note not in notes]  # a model may be judged on several flows
    for note in new:
        _say(note)
    notes += new
    return trained


def _judge(wake: Wake, trained: Trained, arguments: Fluid) -> Splits:
    """Every Reynolds number; at the trained one also without the sequences that overlap."""
    splits: dict[str, Judged] = {}
    for case in cases(wake, arguments.trajectories, arguments.held_out):
        judged = _assess(case, trained, arguments)
        if case.held_out:
            splits[f"reynolds-{case.reynolds:g}"] = judged
        else:
            splits |= {OVERLAPPING: judged, APART: judged.apart()}
    return splits


def _assess(case: Case, trained: Trained, arguments: Fluid) -> Judged:
    path = made(case.system, 1, arguments.seed, arguments.data)
    start = time.perf_counter()
    judged = assess(case, trained, load_sequences(path, case.starts, case.length))
    words = ", ".join(f"{m} {judged.after_fit(m):.4f}" for m in _SUMMARY)
    where = f"{case.wake.name} at Re {case.reynolds:g}"
    _say(f"{where}: L1 after the fit {words} ({time.perf_counter() - start:.0f} s)")
    return judged


def _draw(results: Results, out: Path) -> int:
    """Save the figures; how many."""
    figures = {"figure-14": draw_curves(results)}
    elsewhere = {name: splits for name, splits in results.items() if len(by_reynolds(splits)) > 1}
    if elsewhere:
        figures["held-out"] = draw_held_out(elsewhere)
    for name, splits in results.items():
        figures[f"figure-15-{name}"] = draw_strip(splits[OVERLAPPING])
    for name, figure in figures.items():
        figure.savefig(out / f"{name}.png")
    return len(figures)


def _command(arguments: Fluid) -> str:
    """What makes this report again, without the folders of this machine."""
    words: list[str] = [part for name in arguments.system for part in ("--system", name)]
    words += ["--trajectories", str(arguments.trajectories), "--seed", str(arguments.seed)]
    if arguments.held_out != HELD_OUT:
        words += ["--held-out", *(f"{re:g}" for re in arguments.held_out)]
    return "koop-eval fluid " + shlex.join(words)


def _say(text: str) -> None:
    print(f"koop-eval: {text}", file=sys.stderr)
