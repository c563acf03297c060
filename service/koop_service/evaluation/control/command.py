"""`koop-eval control`: drives the simulated plants by every method, and tells how it went."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from koop_service.encoding.weights import load_card
from koop_service.evaluation.control import report, study
from koop_service.evaluation.control.figures import draw_change, draw_plan, draw_ways, save_film
from koop_service.evaluation.control.plants import Plant, chosen
from koop_service.evaluation.control.trials import Protocol
from koop_service.evaluation.options import Options, at_least_one
from koop_service.evaluation.trained import weights_path


@dataclass(frozen=True)
class Control(Options):
    """Drive simulated plants upright by every method, through Zenoh: success, cost, latency.

    The JSON object holds system, method: success rate, cost, p99.
    """

    system: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Which plant, as often as wanted; "all", or none, is every one."""
    starts: int = 100
    """Starts of each method."""
    together: int = 20
    """Plants that are driven at the same time."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = field(
        default=Path("out/control"), kw_only=True
    )
    """Folder for the figures, table.csv and report.md."""
    seed: int = 0
    """Seed of starts and excitation."""
    rate: Literal["realtime", "max"] = "realtime"
    """max: simulated time waits for each command, so that latencies do not matter."""


def run(arguments: Control) -> None:
    """Judge each plant, draw, and write table and report."""
    for name, value in (("starts", arguments.starts), ("together", arguments.together)):
        at_least_one(name, value)
    protocol = Protocol(arguments.starts, arguments.together, arguments.seed, arguments.rate)
    plants = chosen(arguments.system)
    arguments.out.mkdir(parents=True, exist_ok=True)
    judged = [_judge(plant, arguments, protocol) for plant in plants]
    draw_change([one.change for one in judged], judged[0].dt).savefig(
        arguments.out / "change-of-mass.png"
    )
    with (arguments.out / "table.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([report.COLUMNS, *report.rows(judged)])
    page = report.markdown(judged, protocol, _command(arguments))
    (arguments.out / "report.md").write_text(page, encoding="utf-8")
    print(f"wrote {arguments.out / 'report.md'}, table.csv, figures and films")
    if arguments.json:
        print(json.dumps(report.as_json(judged)))


def _judge(plant: Plant, arguments: Control, protocol: Protocol) -> report.Judged:
    """Run and draw one plant."""
    weights, out = arguments.weights, arguments.out
    dt = load_card(weights_path(weights, plant.system)).dt
    trials = study.compare(plant, weights, protocol, _say)
    found = report.Judged(
        plant,
        dt,
        trials,
        study.change_mass(plant, weights, protocol),
        study.open_loop(plant, weights, protocol),
    )
    draw_ways(trials, dt).savefig(out / f"{plant.name}-ways.png")
    draw_plan(plant, found.open_loop, dt).savefig(out / f"figure-{plant.figure:02}.png")
    save_film(study.closed_loop(plant, weights, protocol), dt, out / f"{plant.name}-film.gif")
    return found


def _command(arguments: Control) -> str:
    """What makes this report again, without the folders of this machine."""
    systems = "".join(f" --system {name}" for name in arguments.system)
    counts = f" --starts {arguments.starts} --seed {arguments.seed}"
    rate = "" if arguments.rate == "realtime" else f" --rate {arguments.rate}"
    return f"koop-eval control{systems}{counts}{rate}"


def _say(text: str) -> None:
    print(f"koop-eval: {text}", file=sys.stderr, flush=True)
