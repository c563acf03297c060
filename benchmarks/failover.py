"""A worker of three killed under load: how long until every trajectory is predicted again.

Three processes beside the workers: a source with a log, which puts the frames of all trajectories
at their rate; this one, which asks for all predictions and kills; and the supervisor. "Answered" is
the first time at which every trajectory has an answer again, "current" when these answers also know
every frame that was put before the kill. Nothing may be lost, and nobody may answer twice.

    python benchmarks/failover.py                 # supervised processes
    python benchmarks/failover.py --engine ray    # actors of a Ray instance on this machine
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import psutil
import zenoh
from koop_serve import Team, team
from load import RENDERER, models, write_weights

from koop_clients.connection import open_session
from koop_clients.replay.log import SourceLog
from koop_clients.sources import FrameSource
from koop_protocol import PredictReply, StateReply, decode, shard_of

WORKERS = 3
PAUSE = 3.0  # s of undisturbed load before a kill
PATIENCE = 120.0  # s


def main() -> None:
    options = parse_options()
    with tempfile.TemporaryDirectory() as folder:
        figures = measured(options, Path(folder))
    for name, value in figures.items():
        print(f"  {name:32} {value:>10.2f}" if isinstance(value, float) else f"  {name:32} {value}")
    if options.json:
        print(json.dumps(figures))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--engine", choices=("processes", "ray"), default="processes")
    parser.add_argument("--trajectories", type=int, default=60)
    parser.add_argument("--rate", type=float, default=20.0, help="frames a second of each")
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--spares", type=int, default=1, help="processes that wait")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


def await_spares(workers: Team, count: int) -> None:
    """Until so many have loaded since the start."""
    end = time.monotonic() + PATIENCE
    while workers.spares() < count:
        if time.monotonic() > end:
            raise RuntimeError(f"no spare is ready after {PATIENCE:g} s")
        time.sleep(0.1)


def stream(endpoint: str, names: list[str], rate: float, log_file: Path, stop: Event, sent) -> None:
    """Put a frame of every trajectory at the rate, until told to stop; then serve the log on."""
    images = np.random.default_rng(0).integers(0, 256, (64, 64, 64), np.uint8)
    with open_session([endpoint]) as session, SourceLog(log_file) as log:
        sources = [FrameSource(session, name, 0, RENDERER, log) for name in names]
        due = time.monotonic()
        while not stop.is_set():
            for i, source in enumerate(sources):
                source.put_frame(images[(sent.value + i) % len(images)])
            sent.value += 1
            due = max(due + 1 / rate, time.monotonic() - 1.0)
            time.sleep(max(0.0, due - time.monotonic()))
        stop.clear()
        stop.wait()


@dataclass
class Witness:
    """Asks for every prediction, and keeps count."""

    session: zenoh.Session
    names: list[str]
    twice: int = 0
    rounds: int = 0
    slowest: float = field(default=0.0)

    def known(self) -> dict[str, int]:
        """The newest frame that each answer knows."""
        started = time.monotonic()
        replies = self.session.get(
            "koop/predict/**?horizon=5",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=5.0,
        )
        found = [decode(r.ok.payload.to_bytes()) for r in replies if r.ok is not None]
        answers = [reply for reply in found if isinstance(reply, PredictReply)]
        self.twice += sum(n > 1 for n in Counter(a.trajectory for a in answers).values())
        self.rounds += 1
        self.slowest = max(self.slowest, time.monotonic() - started)
        return {answer.trajectory: answer.seq for answer in answers}

    def until(self, seq: int) -> float:
        """When every trajectory is answered for, up to this frame [s, monotonic]."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            known = self.known()
            if len(known) == len(self.names) and min(known.values()) >= seq:
                return time.monotonic()
            time.sleep(0.02)
        raise RuntimeError(f"not every trajectory is predicted after {PATIENCE:g} s")

    def frames(self) -> list[int]:
        replies = self.session.get("koop/state/**", target=zenoh.QueryTarget.ALL, timeout=10.0)
        states = [decode(r.ok.payload.to_bytes()) for r in replies if r.ok is not None]
        return [state.frames for state in states if isinstance(state, StateReply)]


def measured(options: argparse.Namespace, folder: Path) -> dict[str, float | int | str]:
    names = [f"benchmark/{i}" for i in range(options.trajectories)]
    spawn = multiprocessing.get_context("spawn")
    stop, sent = spawn.Event(), spawn.Value("q", 0)
    answered, current = [], []
    told = [*models(write_weights(folder)), "--spares", str(options.spares)]
    told += ["--ray"] if options.engine == "ray" else []
    with (
        team(folder / "team", WORKERS, *told) as workers,
        open_session([workers.endpoint]) as session,
    ):
        load = (workers.endpoint, names, options.rate, folder / "source.log", stop, sent)
        source = spawn.Process(target=stream, args=load)
        source.start()
        witness = Witness(session, names)
        witness.until(40)
        for number in range(options.kills):
            if options.spares:
                await_spares(workers, options.spares + number)
            time.sleep(PAUSE)
            before, killed = sent.value, time.monotonic()
            os.kill(workers.workers()[number % WORKERS].process, signal.SIGKILL)
            answered.append(witness.until(0) - killed)
            current.append(witness.until(before - 1) - killed)
        stop.set()
        total = sent.value
        witness.until(total - 1)
        lost = options.trajectories * sent.value - sum(witness.frames())
        stop.set()
        source.terminate()
        source.join()
    return {
        "engine": options.engine,
        "trajectories": options.trajectories,
        "frames a second": options.trajectories * options.rate,
        "workers": WORKERS,
        "spares": options.spares,
        "kills": options.kills,
        "trajectories of the largest": max(Counter(map(owner, names)).values()),
        "answered again [s], mean": float(np.mean(answered)),
        "answered again [s], slowest": float(max(answered)),
        "current again [s], mean": float(np.mean(current)),
        "current again [s], slowest": float(max(current)),
        "frames lost": lost,
        "answered twice": witness.twice,
        "rounds of questions": witness.rounds,
        "load of the machine (1 min)": psutil.getloadavg()[0],
        "cores": os.cpu_count() or 0,
    }


def owner(name: str) -> int:
    return int(shard_of(name), 16) * WORKERS // 64


if __name__ == "__main__":
    main()
