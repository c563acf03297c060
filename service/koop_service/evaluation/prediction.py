"""`koop-eval prediction`: judges every method on unseen trajectories, draws and reports."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from koop_service.evaluation.assessment import Result, assess
from koop_service.evaluation.datasets import test_set
from koop_service.evaluation.figures import FIGURES, RESIDUAL_CAPTION, RESIDUAL_FIGURE
from koop_service.evaluation.options import TestSetOptions
from koop_service.evaluation.report import Report
from koop_service.evaluation.residual import TrainingLog, draw_residuals, read_log
from koop_service.evaluation.studies.command import STUDIES
from koop_service.evaluation.studies.outcome import with_studies
from koop_service.evaluation.systems import System, chosen
from koop_service.evaluation.table import as_json, write_csv
from koop_service.evaluation.trained import MissingWeightsError, load, weights_path


@dataclass(frozen=True)
class Prediction(TestSetOptions):
    """Predict unseen trajectories by every method: the paper's figures, a table and a report.

    The JSON object holds system, method, horizon in seconds: RMSE.
    """

    system: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Which system, as often as wanted; "all", or none, is every one."""


@dataclass
class _Findings:
    """What has been judged so far, and what was left out."""

    results: dict[str, Result] = field(default_factory=dict)
    logs: dict[str, TrainingLog] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Say it now, and again in the report."""
        _say(text)
        self.notes.append(text)


def run(arguments: Prediction) -> None:
    """Judge each system, draw, and write the table and the report."""
    found = _Findings()
    systems = chosen(arguments.system)
    for system in systems:
        _judge(system, arguments, found)
    if not found.results:
        raise ValueError(f"nothing to evaluate: {arguments.weights} holds none of these systems")
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_csv(found.results, arguments.out / "table.csv")
    drawn = _draw(found, {system.name for system in systems}, arguments.out)
    report = Report(found.results, found.logs, drawn, _command(arguments), found.notes)
    page = with_studies(report.markdown(), arguments.out, list(STUDIES))
    (arguments.out / "report.md").write_text(page, encoding="utf-8")
    print(f"wrote {arguments.out / 'report.md'}, table.csv and {len(drawn)} figures")
    if arguments.json:
        print(json.dumps(as_json(found.results)))


def _judge(system: System, arguments: Prediction, found: _Findings) -> None:
    """Add one system to what was found, or note why not."""
    try:
        trained, notes = load(arguments.weights, system)
    except MissingWeightsError as missing:
        found.note(f"{system.name} skipped: {missing}")
        return
    for note in notes:
        found.note(note)
    start = time.perf_counter()
    test = test_set(system, arguments.trajectories, arguments.seed, arguments.data)
    result = assess(system, trained, test)
    found.results[system.name] = result
    log = read_log(weights_path(arguments.weights, system).with_suffix(".csv"))
    if log is not None:
        found.logs[system.name] = log
    _say(f"{_summary(result)} ({time.perf_counter() - start:.0f} s)")


def _summary(result: Result) -> str:
    """The regimes' errors over all that comes after the fit."""
    methods = ("offline", "partial", "full", "repeat-last")
    after = {m: result.errors[m][:, result.system.fit_frames :].mean() for m in methods}
    words = ", ".join(f"{m} {np.sqrt(error):.3f}" for m, error in after.items())
    return f"{result.system.name}: RMSE after the fit {words}"


def _draw(found: _Findings, asked: set[str], out: Path) -> Mapping[int, tuple[str, str]]:
    """Save every figure that can be drawn; number -> (file name, caption).

    What a figure lacks is worth a note only where its system was asked for.
    """
    drawn = {}
    for figure in FIGURES:
        missing = [f"{m} of {name}" for name, m in figure.missing(found.results) if name in asked]
        if missing:
            found.note(f"figure {figure.number} lacks {', '.join(missing)}")
        if figure.drawable(found.results):
            name = f"figure-{figure.number:02}.png"
            figure.draw(found.results).savefig(out / name)
            drawn[figure.number] = (name, figure.caption)
    if found.logs:
        name = f"figure-{RESIDUAL_FIGURE}.png"
        draw_residuals(found.logs).savefig(out / name)
        drawn[RESIDUAL_FIGURE] = (name, RESIDUAL_CAPTION)
    else:
        found.note(f"figure {RESIDUAL_FIGURE} lacks the logs that koop-train leaves beside weights")
    return drawn


def _command(arguments: Prediction) -> str:
    """What makes this report again, without the folders of this machine."""
    systems = [part for name in arguments.system for part in ("--system", name)]
    counts = ["--trajectories", str(arguments.trajectories), "--seed", str(arguments.seed)]
    return "koop-eval prediction " + shlex.join([*systems, *counts])


def _say(text: str) -> None:
    print(f"koop-eval: {text}", file=sys.stderr)
