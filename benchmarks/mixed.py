"""One flow past a cylinder and 50 mechanical streams on one service, in real time, without loss.

Four processes: the real `koop-serve` with its bundled models; a source that puts the frames of 50
free cartpoles, drawn before anything is timed, spread evenly over each twentieth of a second; the
real `koop-sim-client --system cylinder --actuated`, which computes its flow as it goes; and this
one, which asks for predictions of both and watches the queue. All that was put must be folded.

    python benchmarks/mixed.py                          # a minute; the flow at its own 6.7 Hz
    python benchmarks/mixed.py --flow-rate 20 --minutes 3
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
from koop_serve import Service, seconds_of, service

from koop_clients.connection import open_session
from koop_clients.flow.settings import FRAME_INTERVAL
from koop_clients.mechanics.rendering import RENDERER
from koop_clients.mechanics.systems import build_system
from koop_clients.mechanics.trajectories import simulate
from koop_clients.queries import KoopClient, KoopError
from koop_clients.sources import FrameSource

RATE = 20.0  # frames/s of a mechanical stream
DRAWN = 60  # frames of each, shown to and fro
FLOW, PLANT = "cylinder-actuated/0", "cartpole/{}"
HORIZON = 20
SETTLING = 10.0  # s of streaming before anything counts, ...
EMPTY, CATCHING_UP = 5, 60.0  # ... and until so few messages wait, or so many seconds have passed
INTERVAL = 0.1  # s between two looks at the queue, and between two questions
PATIENCE = 300.0  # s
FOLDED, HELD = "koop_frames_total", "koop_held_total"


def main() -> None:
    options = parse_options()
    with (
        tempfile.TemporaryDirectory() as folder,
        service(Path(folder), *serving(options)) as served,
    ):
        with streaming(options, served, Path(folder) / "client.log") as streams:
            watched = watch(options, served, streams)
        figures = figures_of(options, served, streams, watched)
    print_table(figures)
    if options.json:
        print(json.dumps({name: round(value, 4) for name, value in figures.items()}))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=1.0, help="time that counts")
    parser.add_argument("--streams", type=int, default=50, help="mechanical streams at 20 Hz")
    parser.add_argument("--flow-rate", type=float, default=1 / FRAME_INTERVAL, help="frames/s")
    parser.add_argument("--threads", type=int, default=1, help="threads of the encoder")
    parser.add_argument("--shared-memory", action="store_true", help="koop-serve takes it")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


def serving(options: argparse.Namespace) -> list[str]:
    shared = ["--shared-memory"] if options.shared_memory else []
    return ["--threads", str(options.threads), "--log-level", "warning", *shared]


# The streams


@dataclass
class Streams:
    """What streams; `sent` counts the mechanical frames, `flow` is the client's own summary."""

    cylinder: subprocess.Popen[str]
    sent: Any
    flow: dict[str, Any] = field(default_factory=dict)


@contextmanager
def streaming(options: argparse.Namespace, served: Service, log: Path) -> Iterator[Streams]:
    """Both kinds under way; at the end all has been put and has arrived."""
    context = multiprocessing.get_context("spawn")
    stop, sent = context.Event(), context.Value("q", 0)
    arguments = (served.endpoint, options.streams, stop, sent)
    mechanical = context.Process(target=put_mechanical, args=arguments)
    mechanical.start()
    streams = Streams(cylinder_client(options, served, log), sent)
    try:
        await_both(served, options.streams)
        yield streams
    finally:
        stop.set()
        streams.cylinder.terminate()  # which it takes for Ctrl-C: it says what it has done
        said, _ = streams.cylinder.communicate(timeout=PATIENCE)
        mechanical.join()
    if streams.cylinder.returncode != 0:
        raise RuntimeError(f"koop-sim-client failed: {log.read_text()[-2000:]}")
    streams.flow = json.loads(said.splitlines()[-1])


def cylinder_client(
    options: argparse.Namespace, served: Service, log: Path
) -> subprocess.Popen[str]:
    rate = str(options.flow_rate * FRAME_INTERVAL)
    command = [sys.executable, "-m", "koop_clients.sim_client.cli", "--system", "cylinder"]
    command += ["--actuated", "--duration", "0", "--rate", rate, "--json"]
    # It asks once, at its beginning; from then on the one who asks is `watch`.
    command += ["--ask-every", "1e9", "--connect", served.endpoint]
    with log.open("w") as errors:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)


def put_mechanical(endpoint: str, count: int, stop: Event, sent: Any) -> None:
    """Frames of all plants in turn, each twenty times a second, until told to stop."""
    system = build_system("cartpole")
    films = [_to_and_fro(simulate(system, "free", np.random.default_rng(i), DRAWN).frames)
             for i in range(count)]  # fmt: skip
    with open_session(endpoint) as session:
        sources = [FrameSource(session, PLANT.format(i), 0, RENDERER) for i in range(count)]
        start, number = time.monotonic(), 0
        while not stop.is_set():
            for i, (source, film) in enumerate(zip(sources, films, strict=True)):
                due = start + (number + i / count) / RATE
                time.sleep(max(0.0, due - time.monotonic()))
                source.put_frame(film[number % len(film)])
                sent.value += 1
            number += 1
        for source in sources:
            source.close()


def _to_and_fro(frames: np.ndarray) -> np.ndarray:
    return np.concatenate([frames, frames[-2:0:-1]])


def await_both(served: Service, count: int) -> None:
    """Until predictions of the flow and of the last plant are answered, and some time more.

    Where no flow is kept from an earlier run, its wake must develop first. While the service loads
    the flow's model, at its first frame, measurements wait.
    """
    deadline = time.monotonic() + PATIENCE
    with open_session(served.endpoint) as session:
        client = KoopClient(session)
        for name in (FLOW, PLANT.format(count - 1)):
            while not _answers(client, name):
                if time.monotonic() > deadline:
                    raise RuntimeError(f"no prediction of {name} in {PATIENCE:g} s")
                time.sleep(INTERVAL)
    time.sleep(SETTLING)
    deadline = time.monotonic() + CATCHING_UP
    while served.metric("koop_queue_messages") > EMPTY and time.monotonic() < deadline:
        time.sleep(INTERVAL)


def _answers(client: KoopClient, name: str) -> bool:
    try:
        client.predict(name, 1)
    except KoopError:
        return False
    return True


# What is watched


@dataclass
class Watched:
    """Of the time that counts: its length [s], frames folded, how often a source was held back, the
    queue's lengths, the answers' times [s], what was refused, and the processor time of the service
    and of the flow's client [s]."""

    seconds: float = 0.0
    frames: int = 0
    held: int = 0
    queue: list[float] = field(default_factory=list)
    asked: dict[str, list[float]] = field(default_factory=lambda: {"flow": [], "plants": []})
    refused: list[str] = field(default_factory=list)
    service_busy: float = 0.0
    client_busy: float = 0.0


def watch(options: argparse.Namespace, served: Service, streams: Streams) -> Watched:
    """Ask in turn for the flow and for one of the plants, and look at the queue."""
    found, choose = Watched(), np.random.default_rng(0)
    busy, names = (lambda: (served.busy(), seconds_of(streams.cylinder))), (FOLDED, HELD)
    before, counted = busy(), [served.metric(name) for name in names]
    start = time.monotonic()
    with open_session(served.endpoint) as session:
        client = KoopClient(session, timeout=PATIENCE)
        while (now := time.monotonic() - start) < 60 * options.minutes:
            found.queue.append(served.metric("koop_queue_messages"))
            plant = PLANT.format(choose.integers(options.streams))
            for kind, name in (("flow", FLOW), ("plants", plant)):
                _time(found, kind, lambda name=name: client.predict(name, HORIZON))
            time.sleep(max(0.0, start + now + INTERVAL - time.monotonic()))
    found.seconds = time.monotonic() - start
    now_counted = [served.metric(name) for name in names]
    found.frames, found.held = (int(b - a) for a, b in zip(counted, now_counted, strict=True))
    found.service_busy, found.client_busy = np.subtract(busy(), before)
    return found


def _time(found: Watched, kind: str, ask: Callable[[], object]) -> None:
    start = time.perf_counter()
    try:
        ask()
    except KoopError as error:
        found.refused.append(error.message)
    found.asked[kind].append(time.perf_counter() - start)


def figures_of(
    options: argparse.Namespace, served: Service, streams: Streams, watched: Watched
) -> dict[str, float]:
    """All streams have ended: what they put must have been folded by now."""
    put = streams.sent.value + streams.flow["frames"]
    deadline = time.monotonic() + PATIENCE
    while served.metric(FOLDED) < put and time.monotonic() < deadline:
        time.sleep(INTERVAL)
    if watched.refused:
        print(f"{len(watched.refused)} queries were refused, the last: {watched.refused[-1]}")
    thirds = np.array_split(np.array(watched.queue), 3)
    figures = {
        "streams": options.streams,
        "seconds": watched.seconds,
        "wanted_per_s": options.streams * RATE + options.flow_rate,
        "frames_per_s": watched.frames / watched.seconds,
        "flow_frames_per_s": streams.flow["frames_per_s"],
        "put": put,
        "lost": put - served.metric(FOLDED),
        "rejected": served.metric("koop_rejected_total"),
        "held_back": watched.held,
        "queue_first": float(thirds[0].mean()),
        "queue_last": float(thirds[-1].mean()),
        "queue_max": max(watched.queue),
        "refused": len(watched.refused),
        "service_cores": watched.service_busy / watched.seconds,
        "client_cores": watched.client_busy / watched.seconds,
        "resident_mb": served.resident() / 1e6,
    }
    for kind, times in watched.asked.items():
        for name, share in (("p50", 0.5), ("p99", 0.99)):
            figures[f"{kind}_{name}_ms"] = 1e3 * float(np.quantile(times, share))
    return figures


def print_table(figures: dict[str, float]) -> None:
    f = figures
    rows = [
        ("frames/s folded", f"{f['frames_per_s']:.1f}", f"{f['wanted_per_s']:.1f} are due"),
        ("of the flow, frames/s put", f"{f['flow_frames_per_s']:.2f}", ""),
        ("lost", f"{f['lost']:.0f} of {f['put']:.0f}", "0"),
        ("rejected", f"{f['rejected']:.0f}", "0"),
        ("times a source was held back", f"{f['held_back']:.0f}", "0"),
        ("messages waiting, first third", f"{f['queue_first']:.1f}", ""),
        ("messages waiting, last third", f"{f['queue_last']:.1f}", "no more than before"),
        ("messages waiting, most", f"{f['queue_max']:.0f}", ""),
        ("predict the flow [ms]", f"{f['flow_p50_ms']:.1f}, {f['flow_p99_ms']:.1f}", "p50, p99"),
        ("predict a plant [ms]", f"{f['plants_p50_ms']:.1f}, {f['plants_p99_ms']:.1f}", ""),
        ("cores that the service took", f"{f['service_cores']:.2f}", ""),
        ("cores that the flow's client took", f"{f['client_cores']:.2f}", ""),
        ("memory of the service [MB]", f"{f['resident_mb']:.0f}", ""),
    ]
    print(f"one flow and {f['streams']:.0f} mechanical streams for {f['seconds']:.0f} s")
    for name, value, note in rows:
        print(f"  {name:34}{value:>16}   {note}".rstrip())


if __name__ == "__main__":
    main()
