"""Start the service and a simulated cartpole as two processes; watch it learn, predict, drive.

Leaves `demo.png` and `demo.json` in the output folder. Exits with 1, and says why, if a part fails
or a figure is not better than repeating the last frame.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from koop_clients.demo.processes import (
    DemoError,
    end_cleanly_on_sigterm,
    free_endpoint,
    service,
    sim_client,
)
from koop_clients.demo.verdict import failures, table
from koop_clients.pictures.hero import draw_hero
from koop_clients.sim_client.record import Record

_BURST = ["--trajectories", "20", "--first", "1", "--duration", "10", "--rate", "max"]


@dataclass(frozen=True)
class Arguments:
    """koop's main job, once: stream a cartpole, predict it, and drive its pole upright."""

    out: Path = Path("out")
    """Folder for demo.png, demo.json and the frames behind the picture, demo.npz."""
    learn: float = 26.0
    """Time that the service watches before it drives [s]."""
    drive: float = 8.0
    """Time that it drives [s]."""
    seed: int = 1
    """Seed of the simulation."""
    models: tuple[str, ...] = ()
    """Own models for the service, PATTERN=FILE each."""


def main() -> None:
    """Entry point."""
    arguments = tyro.cli(Arguments, prog="python -m koop_clients.demo")
    end_cleanly_on_sigterm()
    try:
        objections = demonstrate(arguments)
    except (DemoError, OSError, ValueError) as error:
        sys.exit(f"demo: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    if objections:
        sys.exit("\n".join(["demo: not good enough", *(f"  {text}" for text in objections)]))


def demonstrate(arguments: Arguments) -> list[str]:
    """Carry the demo out; what was not good enough."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="koop-demo-") as name:
        folder = Path(name)
        run, burst = _run(arguments, folder)
        objections = failures(run)
        report = {"run": run, "burst": burst, "failures": objections}
        (arguments.out / "demo.json").write_text(json.dumps(report, indent=1) + "\n")
        print("\n" + table(run, burst))
        draw_hero(Record.load(arguments.out / "demo.npz"), arguments.out / "demo.png")
        print(f"\n  the picture: {arguments.out / 'demo.png'}")
    return objections


def _run(arguments: Arguments, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The results of the drive and of streaming at full speed."""
    endpoint = free_endpoint()
    models = ["--models", *arguments.models] if arguments.models else []
    with service(endpoint, folder, models):
        _say("starting koop-serve; koop-sim-client streams a cartpole to it, in real time")
        run = _stream(endpoint, *_drive_options(arguments))
        _say("and now 20 cartpoles at full speed")
        burst = _stream(endpoint, "--drive", "excite", *_BURST)
    return run, burst


def _drive_options(arguments: Arguments) -> list[str]:
    times = {"--learn": arguments.learn, "--duration": arguments.learn + arguments.drive}
    options = [text for name, value in times.items() for text in (name, str(value))]
    record = str(arguments.out / "demo.npz")
    return ["--drive", "mpc", "--seed", str(arguments.seed), "--record", record, *options]


def _stream(endpoint: str, *options: str) -> dict[str, Any]:
    output = sim_client(endpoint, ["--system", "cartpole", "--json", *options])
    return json.loads(output.splitlines()[-1])


def _say(text: str) -> None:
    print(f"\n> {text}", flush=True)


if __name__ == "__main__":
    main()
