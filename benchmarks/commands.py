"""From a frame to its command: 20 controlled trajectories at 20 Hz on one service.

Three processes: the real `koop-serve` with the bundled cartpole, a source that puts frames and
controls recorded before anything is timed, spread evenly over the frame interval, and this one,
which takes the commands. The bare encoder is timed in the same run: a command cannot be faster.

    python benchmarks/commands.py                 # half a minute for each way to plan
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import zenoh
from koop_serve import service

from koop_clients.connection import open_session
from koop_clients.control import Controller
from koop_clients.mechanics.rendering import RENDERER, Renderer
from koop_clients.mechanics.simulation import FRAME_INTERVAL, with_pole
from koop_clients.mechanics.systems import build_system
from koop_clients.mechanics.trajectories import simulate
from koop_clients.sources import FrameSource
from koop_protocol import LqrQuery

WARM = 100  # frames before the tasks begin
METHODS = ("qp", "gain")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trajectories", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=30.0, help="for each way to plan")
    parser.add_argument("--horizon", type=int, default=10)
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    figures: dict[str, float] = {"encoder_ms": 1000 * bare_encoder()}
    runs = record(options)
    for method in METHODS:
        with tempfile.TemporaryDirectory() as folder:
            latencies, missing = drive(method, options, runs, Path(folder))
        for name, share in (("p50", 0.5), ("p99", 0.99)):
            figures[f"{method}_{name}_ms"] = 1000 * float(np.quantile(latencies, share))
        figures[f"{method}_missing"] = missing
        figures[f"{method}_p50_over_encoder"] = figures[f"{method}_p50_ms"] / figures["encoder_ms"]
    print_table(figures, options)
    if options.json:
        print(json.dumps({name: round(value, 4) for name, value in figures.items()}))


def bare_encoder() -> float:
    """One frame's encoding [s], one at a time, as frames that come alone are."""
    import torch

    from koop_service.encoding.catalogue import Catalogue

    torch.set_num_threads(1)
    entry = Catalogue.bundled().match("cartpole-actuated/0")
    assert entry is not None
    codec, frame = entry.load(), np.zeros((1, 64, 64), np.uint8)
    times = []
    for _ in range(300):
        start = time.perf_counter()
        codec.encode(frame)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def record(options: argparse.Namespace) -> list[tuple[np.ndarray, np.ndarray]]:
    """Frames and torques of a probed cartpole for each trajectory."""
    system, frames = build_system("cartpole"), WARM + round(options.seconds / FRAME_INTERVAL)
    runs = []
    for seed in range(options.trajectories):
        run = simulate(system, "probing", np.random.default_rng(seed), frames)
        runs.append((run.frames, run.controls))
    return runs


def drive(
    method: str, options: argparse.Namespace, runs: list, folder: Path
) -> tuple[list[float], int]:
    """Frame put to command there [s], and how many frames got no command."""
    with (
        service(folder, "--log-level", "error") as served,
        open_session(served.endpoint, wait=10.0) as session,
    ):
        return _drive(session, method, options, runs)


def _drive(
    session: zenoh.Session, method: str, options: argparse.Namespace, runs: list
) -> tuple[list[float], int]:
    names = [f"cartpole-actuated/{i}" for i in range(len(runs))]
    sources = [FrameSource(session, name, 1, RENDERER) for name in names]
    for frame in range(WARM):
        for source, run in zip(sources, runs, strict=True):
            _put(source, run, frame)
    controllers = [_controller(session, name, method, options.horizon) for name in names]
    frames = range(WARM, len(runs[0][0]))
    put: dict[tuple[int, int], float] = {}
    came: dict[tuple[int, int], float] = {}

    def collect() -> None:
        for index, seq in put.keys() - came.keys():  # few: else it delays what it measures
            arrived = controllers[index].arrived(seq)
            if arrived is not None:
                came[index, seq] = arrived

    collector = threading.Event()

    def keep_collecting() -> None:
        while not collector.wait(1.0):  # a controller remembers three seconds of plans
            collect()

    thread = threading.Thread(target=keep_collecting)
    thread.start()
    start = time.monotonic() + 0.1
    for step, frame in enumerate(frames):
        for index, (source, run) in enumerate(zip(sources, runs, strict=True)):
            due = start + FRAME_INTERVAL * (step + index / len(sources))
            time.sleep(max(0.0, due - time.monotonic()))
            put[index, frame] = time.monotonic()
            _put(source, run, frame)
    time.sleep(0.5)
    collector.set()
    thread.join()
    collect()
    for controller in controllers:
        controller.close()
    return [came[key] - put[key] for key in came], len(put) - len(came)


def _put(source: FrameSource, run: tuple[np.ndarray, np.ndarray], frame: int) -> None:
    """The frame, after the control that led to it."""
    pictures, torques = run
    if frame:
        source.put_control(torques[frame - 1])
    source.put_frame(pictures[frame])


def _controller(session: zenoh.Session, name: str, method: str, horizon: int) -> Controller:
    system = build_system("cartpole")
    upright, bound = Renderer(system)(with_pole(system, 0.0).q), np.array([20.0])
    query = LqrQuery(
        horizon, target_image=upright, r=1e-3, u_min=-bound, u_max=bound, method=method, force=True
    )
    controller = Controller(session, name, query, timeout=10.0)
    controller.begin()
    return controller


def print_table(figures: dict[str, float], options: argparse.Namespace) -> None:
    print(f"{options.trajectories} controlled trajectories at 20 Hz, horizon {options.horizon}")
    print(f"  one frame through the bare encoder   {figures['encoder_ms']:6.2f} ms")
    for method in METHODS:
        p50, p99 = figures[f"{method}_p50_ms"], figures[f"{method}_p99_ms"]
        print(
            f"  frame put to command there, {method:<5}    p50 {p50:6.2f} ms, p99 {p99:6.2f} ms, "
            f"{figures[f'{method}_p50_over_encoder']:.1f} times the encoder (p50), "
            f"{figures[f'{method}_missing']:.0f} frames without one"
        )


if __name__ == "__main__":
    main()
