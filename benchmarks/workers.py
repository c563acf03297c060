"""Two workers against one on the same load, in one run: frames a second, and processor time.

A source puts the frames of all trajectories as fast as they are taken. One worker, two, and one
again are measured in turn, so that a machine whose speed drifts favours neither. On a machine that
others use, and where the source needs a core itself, the wall's ratio says little; the processor
time of a frame says what a worker, and the hub in front of it, cost.

    python benchmarks/workers.py
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import psutil
from koop_serve import Team, metric, team
from load import RENDERER, models, write_weights

from koop_clients.connection import open_session
from koop_clients.sources import FrameSource


def main() -> None:
    options = parse_options()
    with tempfile.TemporaryDirectory() as folder:
        weights = write_weights(Path(folder))
        runs = [
            measured(options, Path(folder) / f"{number}", weights, count)
            for number, count in enumerate((1, 2, 1))
        ]
    one = np.mean([[r.frames_per_s, r.worker_us, r.hub_us] for r in (runs[0], runs[2])], axis=0)
    two = runs[1]
    figures = {
        "trajectories": options.trajectories,
        "one worker, frames/s": round(float(one[0])),
        "two workers, frames/s": round(two.frames_per_s),
        "ratio": round(two.frames_per_s / float(one[0]), 2),
        "one worker, worker's time a frame [us]": round(float(one[1])),
        "two workers, workers' time a frame [us]": round(two.worker_us),
        "hub's time a frame [us]": round((float(one[2]) + two.hub_us) / 2),
        "cores": os.cpu_count(),
        "load of the machine (1 min)": round(psutil.getloadavg()[0], 1),
    }
    for name, value in figures.items():
        print(f"  {name:42} {value}")
    if options.json:
        print(json.dumps(figures))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trajectories", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10.0, help="time under load, each")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


@dataclass
class Run:
    """Frames a second, and the processor time of each [us]: all workers together, and the hub."""

    frames_per_s: float
    worker_us: float
    hub_us: float


def measured(options: argparse.Namespace, folder: Path, weights: Path, count: int) -> Run:
    with team(folder, count, *models(weights), "--spares", "0") as workers:
        return under_load(options, workers)


def under_load(options: argparse.Namespace, workers: Team) -> Run:
    hub = psutil.Process(workers.supervisor.pid)
    serving = workers.workers().values()
    processes = [psutil.Process(worker.process) for worker in serving]
    ports = [worker.metrics_port for worker in serving]
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    source = spawn.Process(target=publish, args=(workers.endpoint, options.trajectories, stop))
    source.start()
    while frames(ports) < 10 * options.trajectories:
        time.sleep(0.1)
    before = (time.monotonic(), frames(ports), busy(processes), busy([hub]))
    time.sleep(options.seconds)
    after = (time.monotonic(), frames(ports), busy(processes), busy([hub]))
    stop.set()
    source.join()
    seconds, count, worker_time, hub_time = (b - a for a, b in zip(before, after, strict=True))
    return Run(count / seconds, 1e6 * worker_time / count, 1e6 * hub_time / count)


def publish(endpoint: str, trajectories: int, stop: Event) -> None:
    """Put a frame of each in turn, as fast as they are taken."""
    images = np.random.default_rng(0).integers(0, 256, (64, 64, 64), np.uint8)
    with open_session([endpoint]) as session:
        sources = [FrameSource(session, f"benchmark/{i}", 0, RENDERER) for i in range(trajectories)]
        number = 0
        while not stop.is_set():
            for i, source in enumerate(sources):
                source.put_frame(images[(number + i) % len(images)])
            number += 1


def busy(processes: list[psutil.Process]) -> float:
    """Processor time of these so far [s]."""
    return sum(sum(p.cpu_times()[:2]) for p in processes)


def frames(ports: list[int]) -> float:
    """Frames folded so far, by all workers."""
    return sum(metric(port, "koop_frames_total") for port in ports)


if __name__ == "__main__":
    main()
