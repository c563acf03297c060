"""`koop-eval fluid-control`: lets every method calm the same wakes, and tells how it went."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from koop_service.evaluation.control.plants import Plant
from koop_service.evaluation.control.servers import koop_serve, learned_b
from koop_service.evaluation.fluid.cases import WAKES, cases
from koop_service.evaluation.fluid.control import report
from koop_service.evaluation.fluid.control import trials as running
from koop_service.evaluation.fluid.control.figures import draw_strip, draw_swings, save_film
from koop_service.evaluation.fluid.control.methods import METHODS, Method
from koop_service.evaluation.fluid.control.trials import Protocol, Trials
from koop_service.evaluation.options import Options, at_least_one

BOUND = 0.42
"""koop-sim-client's own default [U/D]."""


@dataclass(frozen=True)
class FluidControl(Options):
    """Calm the wake behind a cylinder by every method, through Zenoh: the paper's figure 16.

    The JSON object holds method: wakes calmed, frames until then, swings, rotation.
    """

    wakes: int = 5
    """Wakes, each from a phase and with a schedule of its own."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = field(
        default=Path("out/fluid"), kw_only=True
    )
    """Folder for the figures, control.csv and control.md."""
    seed: int = 2000
    """Seed of phases and schedules; training's are below 1000."""
    rate: Literal["realtime", "max"] = "max"
    """max: simulated time waits for each command, since several wakes take more than real time."""
    method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Which method, as often as wanted; none is every one."""

    def check(self) -> None:
        super().check()
        at_least_one("wakes", self.wakes)
        for name in self.method:
            if name not in METHODS:
                raise ValueError(f"--method {name}: unknown; there are {', '.join(METHODS)}")


def run(arguments: FluidControl) -> None:
    """Run each method, draw, and write table and report."""
    protocol = Protocol(arguments.wakes, arguments.seed, arguments.rate)
    names = arguments.method or tuple(METHODS)
    trials = {name: _try(METHODS[name], arguments.weights, protocol) for name in names}
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    with (out / "control.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([report.COLUMNS, *report.rows(trials)])
    shown = trials.get("mpc", next(iter(trials.values())))
    draw_strip(shown).savefig(out / "figure-16.png")
    draw_swings(trials).savefig(out / "control-swings.png")
    if len(shown.momenta):
        save_film(shown, out / "control-film.gif")
    page = report.markdown(trials, protocol, BOUND, _command(arguments))
    (out / "control.md").write_text(page, encoding="utf-8")
    print(f"wrote {out / 'control.md'}, control.csv, figures and a film")
    if arguments.json:
        print(json.dumps(report.as_json(trials)))


def _try(method: Method, weights: Path, protocol: Protocol) -> Trials:
    serve = koop_serve if method.server == "service" else learned_b
    with serve(plant(), weights) as endpoint:
        found = running.run(method.drive, endpoint, protocol)
    print(
        f"koop-eval: {method.title}: {sum(found.success)} of {len(found.success)} wakes calmed",
        file=sys.stderr,
        flush=True,
    )
    return found


def plant() -> Plant:
    """The turning cylinder, as the servers of other plants take one."""
    system = next(cases(WAKES["cylinder-actuated"], 1, ())).system
    return Plant(system, "cylinder", 16)


def _command(arguments: FluidControl) -> str:
    """What makes this report again, without the folders of this machine."""
    methods = "".join(f" --method {name}" for name in arguments.method)
    rate = "" if arguments.rate == "max" else f" --rate {arguments.rate}"
    counts = f" --wakes {arguments.wakes} --seed {arguments.seed}"
    return f"koop-eval fluid-control{counts}{rate}{methods}"
