"""The whole service under full load: throughput against the bare encoder, losses, latency, memory.

Four processes: the real `koop-serve`, a source that puts the frames of all trajectories as fast as
the service takes them, a client that asks for predictions all the while, and this one, which
watches. The bare encoder is measured in the same run, before and after, with the same threads.

    python benchmarks/service.py                  # half a minute of load
    python benchmarks/service.py --minutes 10     # and does the memory stay flat?
    python benchmarks/service.py --flood 2        # and do two greedy clients slow the sources down?
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import zenoh
from koop_serve import Service, service
from load import PICTURES, Templates, growth, models, pictures, write_weights

from koop_clients.connection import open_session
from koop_protocol import PredictQuery, decode, encode, predict_key, state_key

HORIZON = 20
QUERY_INTERVAL = 0.02  # s
WARM_SECONDS = 3.0


def main() -> None:
    options = parse_options()
    with tempfile.TemporaryDirectory() as folder:
        weights = write_weights(Path(folder))
        bare = [bare_encoder(weights, options.threads, options.device)]
        figures = under_load(options, Path(folder), weights)
        bare.append(bare_encoder(weights, options.threads, options.device))
    # The mean of before and after, so that a machine whose speed drifts favours neither side.
    figures["bare_encoder_per_s"] = sum(bare) / len(bare)
    figures["encoder_ratio"] = figures["frames_per_s"] / figures["bare_encoder_per_s"]
    print_table(figures)
    if options.json:
        print(json.dumps({name: round(value, 4) for name, value in figures.items()}))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trajectories", type=int, default=200, help="at least 4")
    parser.add_argument("--minutes", type=float, default=0.5, help="time under load")
    parser.add_argument("--threads", type=int, default=1, help="threads of the encoder")
    parser.add_argument("--device", default="cpu", help="of the encoder: cpu, cuda")
    parser.add_argument("--batch", type=int, default=None, help="koop-serve's --batch")
    parser.add_argument(
        "--flood", type=int, default=0, help="clients that ask for costly predictions without pause"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    if options.trajectories < 4:
        parser.error("at least 4 trajectories: a quarter of them goes first")
    return options


# The encoder alone


def bare_encoder(weights: Path, threads: int, device: str) -> float:
    """Frames a second of ImageCodec.encode alone, at its best batch size, in a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_bare_encoder, (weights, threads, device))


def _bare_encoder(weights: Path, threads: int, device: str) -> float:
    import torch

    from koop_service.encoding.image_codec import ImageCodec
    from koop_service.encoding.weights import load_weights

    torch.set_num_threads(threads)
    codec = ImageCodec(*load_weights(weights), device)
    return max(_encoding_rate(codec, pictures(batch)) for batch in (16, 32, 64, 128))


def _encoding_rate(codec, batch: np.ndarray, seconds: float = 1.0) -> float:
    """Sustained rate, as the service's own is."""
    codec.encode(batch)
    start, count = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - start) < seconds:
        codec.encode(batch)
        count += len(batch)
    return count / elapsed


# The load


def publish(endpoint: str, trajectories: list[str], first: int, stop: Event, sent) -> None:
    """Put frames of all trajectories in turn, as fast as they are taken, until told to stop."""
    images = pictures(PICTURES)
    templates = [Templates(name, np.roll(images, i, 0)[:16]) for i, name in enumerate(trajectories)]
    with open_session(endpoint) as session:
        publishers = [
            session.declare_publisher(t.key, congestion_control=zenoh.CongestionControl.BLOCK)
            for t in templates
        ]
        seq = first
        while not stop.is_set():
            for template, publisher in zip(templates, publishers, strict=True):
                publisher.put(template.message(seq))
            seq += 1
            sent.value = (seq - first) * len(trajectories)
        # Closing a session drops what it has not sent yet; an answer proves that all of it has
        # arrived, since a query is answered after the measurements that came before it.
        for name in trajectories:
            list(session.get(state_key(name), timeout=60.0))


def ask(endpoint: str, trajectories: list[str], stop: Event, results) -> None:
    """Ask for a prediction every 20 ms, and note how long the answer took."""
    query, choose = encode(PredictQuery(HORIZON)), np.random.default_rng(0)
    latencies, refusals = [], []
    with open_session(endpoint) as session:
        while not stop.is_set():
            key = predict_key(trajectories[choose.integers(len(trajectories))])
            start = time.perf_counter()
            (reply,) = session.get(key, payload=query, timeout=30.0)
            latencies.append(time.perf_counter() - start)
            if reply.ok is None:
                refusals.append(decode(reply.err.payload.to_bytes()).message)
            time.sleep(QUERY_INTERVAL)
    results.put((latencies, refusals))


def flood(endpoint: str, trajectories: list[str], stop: Event) -> None:
    """Ask for pictures and deviations, several at once and without pause."""
    query = encode(PredictQuery(100, returns=frozenset({"codes", "frames", "std"})))
    with open_session(endpoint) as session:
        while not stop.is_set():
            keys = [predict_key(name) for name in trajectories[:16]]
            for answers in [session.get(key, payload=query, timeout=30.0) for key in keys]:
                list(answers)


@dataclass
class Load:
    """One stretch of full load."""

    sent: int
    folded: int
    frames_per_s: float
    resident: list[tuple[float, int]]
    latencies: list[float]
    refusals: list[str]


def under_load(options: argparse.Namespace, folder: Path, weights: Path) -> dict[str, float]:
    """A quarter of the trajectories first: what does not grow with their number is in place then,
    a full queue too."""
    names = [f"benchmark/{i}" for i in range(options.trajectories)]
    arguments = [*models(weights), "--threads", str(options.threads)]
    arguments += ["--device", options.device]
    arguments += ["--batch", str(options.batch)] if options.batch else []
    with service(folder / "state", *arguments) as served:
        few = names[: len(names) // 4]
        some = run(served, few, 0, WARM_SECONDS)
        first = some.sent // len(few)
        several = run(served, names, first, WARM_SECONDS)
        first += several.sent // len(names)
        load = run(served, names, first, 60.0 * options.minutes, options.flood)
        held, shed = served.metric("koop_held_total"), served.metric("koop_shed_total")
    grown = load.resident[-1][1] - some.resident[-1][1]
    figures = figures_of(options, load, grown / (len(names) - len(few)))
    return figures | {"held_back": held, "shed": shed}


def run(served: Service, names: list[str], first: int, seconds: float, floods: int = 0) -> Load:
    """Stream and ask for a while, then wait until everything sent is folded."""
    context = multiprocessing.get_context("spawn")
    stop, sent, results = context.Event(), context.Value("q", 0), context.Queue()
    before = served.metric("koop_frames_total")
    processes = [
        context.Process(target=publish, args=(served.endpoint, names, first, stop, sent)),
        context.Process(target=ask, args=(served.endpoint, names, stop, results)),
    ]
    processes += [
        context.Process(target=flood, args=(served.endpoint, names, stop)) for _ in range(floods)
    ]
    for process in processes:
        process.start()
    frames_per_s, resident = watch(served, seconds)
    stop.set()
    latencies, refusals = results.get()
    for process in processes:
        process.join()
    folded = int(served.metric("koop_frames_total") - before)
    return Load(sent.value, folded, frames_per_s, resident, latencies, refusals)


def figures_of(options: argparse.Namespace, load: Load, each: float) -> dict[str, float]:
    """The figures to print; `each` is a trajectory's part of the resident memory [bytes]."""
    if load.refusals:
        print(f"{len(load.refusals)} queries were refused, the last with: {load.refusals[-1]}")
    latencies, resident = load.latencies, load.resident[-1][1]
    return {
        "trajectories": options.trajectories,
        "seconds": 60.0 * options.minutes,
        "threads": options.threads,
        "frames_per_s": load.frames_per_s,
        "sent": load.sent,
        "lost": load.sent - load.folded,
        "queries": len(latencies),
        "refused": len(load.refusals),
        "predict_p50_ms": 1e3 * float(np.percentile(latencies, 50)),
        "predict_p99_ms": 1e3 * float(np.percentile(latencies, 99)),
        "predict_max_ms": 1e3 * max(latencies),
        "resident_mb": resident / 1e6,
        "kb_per_trajectory": each / 1e3,
        "growth_kb_per_min": growth(load.resident) / 1e3,
    }


def watch(served: Service, seconds: float) -> tuple[float, list[tuple[float, int]]]:
    """Frames a second over the stretch, and (time [s], resident memory [bytes]) along it."""
    while served.metric("koop_queue_messages") == 0:
        time.sleep(0.01)
    start, frames, resident = time.monotonic(), served.metric("koop_frames_total"), []
    while (now := time.monotonic() - start) < seconds:
        resident.append((now, served.resident()))
        time.sleep(0.5)
    rate = (served.metric("koop_frames_total") - frames) / (time.monotonic() - start)
    return rate, resident


def print_table(figures: dict[str, float]) -> None:
    rows = [
        ("bare encoder, frames/s", f"{figures['bare_encoder_per_s']:.0f}", ""),
        ("service, frames/s", f"{figures['frames_per_s']:.0f}", ""),
        ("encoder_ratio", f"{figures['encoder_ratio']:.2f}", "at least 0.6"),
        ("lost", f"{figures['lost']:.0f} of {figures['sent']:.0f}", "0"),
        ("predict p50 [ms]", f"{figures['predict_p50_ms']:.1f}", ""),
        ("predict p99 [ms]", f"{figures['predict_p99_ms']:.1f}", "under 50"),
        ("costly queries shed", f"{figures['shed']:.0f}", ""),
        ("predict slowest [ms]", f"{figures['predict_max_ms']:.1f}", ""),
        ("memory a trajectory [KB]", f"{figures['kb_per_trajectory']:.0f}", "under 100"),
        ("memory growth [KB/min]", f"{figures['growth_kb_per_min']:.0f}", "flat"),
    ]
    print(
        f"{figures['trajectories']:.0f} trajectories for {figures['seconds']:.0f} s, "
        f"encoder on {figures['threads']:.0f} thread(s), {figures['queries']:.0f} queries"
    )
    for name, value, goal in rows:
        print(f"  {name:26} {value:>20}   {goal}")


if __name__ == "__main__":
    main()
