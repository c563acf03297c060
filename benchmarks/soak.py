"""Everything at once, for long: does the service stay as it was in its first minute?

Sources at 20 Hz that restart now and then and ask for a prediction at every frame, somebody who
puts and asks nonsense, and tasks that drive one trajectory after the other, all against the real
koop-serve. Memory, latency and loss are sampled and drawn; a verdict ends it.

    python benchmarks/soak.py                            # two minutes
    python benchmarks/soak.py --minutes 600 --json       # a night; out/soak.png
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from koop_serve import Service, service
from load import arguments, write_weights
from soaking import roles
from soaking.figure import draw
from soaking.verdict import Sample, Verdict, judge

from koop_clients.connection import open_session
from koop_clients.queries import KoopClient

SAMPLES = 600
"""Most samples of a run."""


def main() -> None:
    options = parse_options()
    with tempfile.TemporaryDirectory() as folder:
        verdict, samples, latencies = soak(options, Path(folder))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    draw(options.out, samples, latencies)
    print_table(verdict, options)
    if options.json:
        print(json.dumps(verdict.figures | {"sound": verdict.sound, "why": verdict.why}))
    sys.exit(not verdict.sound)


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--sources", type=int, default=5, help="good ones, at 20 Hz")
    parser.add_argument("--life", type=float, help="of a source until it restarts [s]")
    parser.add_argument("--spoilt", type=float, default=50.0, help="bad messages a second")
    parser.add_argument("--out", type=Path, default=Path("out/soak.png"), help="the figure")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    options.life = options.life or 60.0 * options.minutes / 4
    return options


def soak(
    options: argparse.Namespace, folder: Path
) -> tuple[Verdict, list[Sample], list[tuple[float, float]]]:
    """Run all roles against one service; what they and it saw."""
    weights = write_weights(folder)
    with service(folder / "state", *arguments(weights)) as served:
        found, samples = run(options, served)
        states = states_of(served, options.sources)
    code = served.process.returncode
    verdict = judge(options.minutes, samples, found, states, code)
    return verdict, samples, found["answers"].latencies


def run(options: argparse.Namespace, served: Service) -> tuple[dict[str, Any], list[Sample]]:
    """Start the roles, sample until the time is over, and stop them."""
    context = multiprocessing.get_context("spawn")
    stop, results = context.Event(), context.Queue()
    seconds = 60.0 * options.minutes
    shared = (served.endpoint, options.sources)
    processes = [
        context.Process(target=role, args=(*shared, setting, stop, results))
        for role, setting in (
            (roles.stream, options.life),
            (roles.spoil, options.spoilt),
            (roles.drive, min(5.0, seconds / 8)),
        )
    ]
    for process in processes:
        process.start()
    samples = sample(served, seconds)
    stop.set()
    found: dict[str, Any] = {}
    for _ in processes:
        found |= results.get(timeout=300)
    for process in processes:
        process.join()
    return found, [*samples, look(served)]


def sample(served: Service, seconds: float) -> list[Sample]:
    """Look at the service at an even pace, from the first frame on."""
    while served.metric("koop_frames_total") == 0:
        time.sleep(0.05)
    start, samples = time.monotonic(), []
    while time.monotonic() < start + seconds:
        samples.append(look(served))
        time.sleep(max(0.25, seconds / SAMPLES))
    return samples


def look(served: Service) -> Sample:
    """The service now."""
    return Sample(
        time.monotonic(),
        served.resident(),
        served.metric("koop_frames_total"),
        served.metric("koop_rejected_total"),
        served.metric("koop_lost_total"),
        served.metric("koop_queue_messages"),
    )


def states_of(served: Service, count: int) -> dict[str, Any]:
    """What the service says of the good trajectories."""
    with open_session(served.endpoint) as session:
        client = KoopClient(session, timeout=60.0)
        return {name: client.state(name) for name in roles.names_of(count)}


def print_table(verdict: Verdict, options: argparse.Namespace) -> None:
    f = verdict.figures
    rows = [
        ("frames of good sources", f"{f['frames']}, {f['starts']} starts", f"{f['lost']} lost"),
        ("predictions", f"{f['predictions']}", f"{f['unanswered']} questions unanswered"),
        (
            "  from frame to answer",
            f"p50 {f['predict_p50_ms']} ms",
            f"p99 {f['predict_p99_ms']} ms",
        ),
        ("commands", f"{f['commands']}", f"{f['tasks']} tasks"),
        ("bad messages", f"{f['spoilt']}", f"{f['rejected']} rejected"),
        ("resident memory", f"{f['resident_mb']} MB", f"{f['growth_kb_per_min']} KB/min"),
    ]
    print(f"{options.sources} sources at 20 Hz for {options.minutes:g} minutes; see {options.out}")
    for row in rows:
        print(f"  {row[0]:26}{row[1]:>24}   {row[2]}")
    print("sound" if verdict.sound else f"NOT sound: {'; '.join(verdict.why)}")


if __name__ == "__main__":
    main()
