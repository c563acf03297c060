"""What a flood from one source costs the others: latency of their predictions, with and without.

Sources at 20 Hz put a frame and ask for a prediction that includes it. Beside them one more puts as
fast as it is let: good frames of one trajectory, bad messages on its own key, and bad messages or
good first frames under ever new names. Quiet and flooded stretches alternate, so that a machine
whose speed drifts favours neither side. Four processes: koop-serve, the sources, the flood, and
this one.

    python benchmarks/flood.py                       # two minutes
    python benchmarks/flood.py --minutes 20 --json
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import zenoh
from koop_serve import Service, service
from load import PICTURES, Templates, arguments, ask, pictures, write_weights
from nonsense import spoilt_frames

from koop_clients.connection import flush, open_session
from koop_protocol import PredictQuery, encode, frame_key, predict_key, shard_of

INTERVAL = 0.05  # s between two frames of a source
HORIZON = 20
QUIET, GOOD, BAD, STRANGE, NEW = range(5)
FLOODS = {"good": GOOD, "bad": BAD, "strange": STRANGE, "new": NEW}
STRETCH = 3.0  # s, after SETTLE
SETTLE, DRAINED = 0.5, 30.0  # s in which the last stretch may be felt; s at most for its backlog
STORED = 4.0  # s until what came of that is stored
WARM_FRAMES = 60
FLOODED = "benchmark/flood"


def main() -> None:
    options = parse_options()
    with tempfile.TemporaryDirectory() as folder:
        weights = write_weights(Path(folder))
        with service(Path(folder) / "state", *arguments(weights)) as served:
            figures = measure(options, served)
    print_table(figures, options)
    if options.json:
        print(json.dumps({name: round(value, 4) for name, value in figures.items()}))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sources", type=int, default=10, help="that are not flooding")
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--floods", nargs="+", choices=list(FLOODS), default=list(FLOODS))
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


def measure(options: argparse.Namespace, served: Service) -> dict[str, float]:
    """Alternate stretches until the time is over; then compare."""
    context = multiprocessing.get_context("spawn")
    stretch, kind, results = context.Value("q", -1), context.Value("q", QUIET), context.Queue()
    stop = context.Event()
    arguments = (served.endpoint, options.sources, stretch, stop, results)
    processes = [
        context.Process(target=stream, args=arguments),
        context.Process(target=flood, args=(served.endpoint, kind, stop, results)),
    ]
    for process in processes:
        process.start()
    kinds = list(alternate(options, served, stretch, kind))
    stop.set()
    found = dict(results.get() for _ in processes)
    for process in processes:
        process.join()
    seconds = {which: kinds.count(which) * (SETTLE + STRETCH) for which in kinds}
    rates = {f"{n}_per_s": found["put"][k] / seconds[k] for n, k in FLOODS.items() if k in seconds}
    return (
        compare(kinds, found["latencies"])
        | rates
        | {
            "lost": served.metric("koop_lost_total"),
            "resident_mb": served.resident() / 1e6,
        }
    )


def alternate(
    options: argparse.Namespace, served: Service, stretch: Any, kind: Any
) -> Iterator[int]:
    """Go through the stretches; the kind of each."""
    while served.metric("koop_trajectories_ready") < options.sources:
        time.sleep(0.2)
    end, number = time.monotonic() + 60.0 * options.minutes, 0
    while time.monotonic() < end:
        for name in options.floods:
            for which in (QUIET, FLOODS[name]):
                kind.value = which
                settle(served, which)
                stretch.value = number
                time.sleep(STRETCH)
                stretch.value = -1
                number += 1
                yield which


def settle(served: Service, which: int) -> None:
    """Before a quiet stretch, until what the flood has put is folded, also what its link holds, and
    stored: else the stretch that it is compared with would pay for it too."""
    time.sleep(SETTLE)
    deadline, empty = time.monotonic() + DRAINED, 0
    while which == QUIET and empty < 5 and time.monotonic() < deadline:
        time.sleep(SETTLE / 5)
        empty = empty + 1 if served.metric("koop_queue_messages") < 5 else 0
    if which == QUIET:
        time.sleep(STORED)


def compare(kinds: list[int], latencies: list[tuple[int, float]]) -> dict[str, float]:
    """The median stretch's percentiles, quiet and flooded, and what each flood costs the p99.

    A flooded stretch is compared with the quiet one just before it; `cost` is the median of these
    ratios less one, `cost_low` and `cost_high` the quartiles. So a machine that stands still for a
    moment, in whichever stretch, does not decide.
    """
    by_stretch: dict[int, list[float]] = defaultdict(list)
    for number, latency in latencies:
        by_stretch[number].append(1e3 * latency)
    figures: dict[str, float] = {}
    for name, which in FLOODS.items():
        pairs = [
            (by_stretch[n - 1], by_stretch[n])
            for n, kind in enumerate(kinds)
            if kind == which and by_stretch[n - 1] and by_stretch[n]
        ]
        if not pairs:
            continue
        for share in (50, 99):
            each = np.array([[np.percentile(side, share) for side in pair] for pair in pairs])
            for state, values in zip(("quiet", "flood"), each.T, strict=True):
                figures[f"{name}_{state}_p{share}_ms"] = float(np.median(values))
            if share == 99:
                low, middle, high = np.percentile(each[:, 1] / each[:, 0] - 1.0, (25, 50, 75))
                figures |= {f"{name}_cost": middle, f"{name}_cost_low": low}
                figures |= {f"{name}_cost_high": high, f"{name}_stretches": len(pairs)}
    return figures


# The others


@dataclass
class Source:
    """One trajectory at 20 Hz on a session of its own."""

    session: zenoh.Session
    templates: Templates
    name: str
    latencies: list[tuple[int, float]]
    seq: int = 0
    query: bytes = field(default_factory=lambda: encode(PredictQuery(HORIZON)))

    def step(self, stretch: int) -> None:
        """Put a frame, and note how long the prediction takes that includes it."""
        start = time.perf_counter()
        self.session.put(
            self.templates.key,
            self.templates.message(self.seq),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        self.seq += 1

        def arrived(code: str) -> None:
            if stretch >= 0 and not code:
                self.latencies.append((stretch, time.perf_counter() - start))

        ask(self.session, predict_key(self.name), self.query, arrived)


def stream(endpoint: str, count: int, stretch: Any, stop: Any, results: Any) -> None:
    """Step all sources in turn, evenly over the interval, until told to stop."""
    images, latencies = pictures(PICTURES), []
    with ExitStack() as stack:
        sources = []
        for i in range(count):
            session = stack.enter_context(open_session(endpoint))
            name = f"benchmark/{i}"
            templates = Templates(name, np.roll(images, i, 0)[:16])
            sources.append(Source(session, templates, name, latencies))
        start, step = time.monotonic(), 0
        while not stop.is_set():
            step += 1
            time.sleep(max(0.0, start + INTERVAL * step / count - time.monotonic()))
            sources[step % count].step(stretch.value)
        for source in sources:
            flush(source.session)
    results.put(("latencies", latencies))


# The flood


def flood(endpoint: str, kind: Any, stop: Any, results: Any) -> None:
    """Put as fast as is let what is asked for, until told to stop.

    Only while nobody else wants the processor: a real flood comes from another machine. The lowest
    priority is not enough: even such a process runs for some milliseconds before Linux gives the
    processor to one that wakes, and costs the others about as much as a flood.
    """
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    else:
        os.nice(19)
    messages = {QUIET: None, **{which: maker() for which, maker in _MAKERS.items()}}
    put: dict[int, int] = defaultdict(int)
    with open_session(endpoint) as session:
        while not stop.is_set():
            which = kind.value
            make = messages[which]
            if make is None:
                time.sleep(0.01)
                continue
            for _ in range(16):
                session.put(*next(make), congestion_control=zenoh.CongestionControl.BLOCK)
            put[which] += 16
    results.put(("put", dict(put)))


def good() -> Iterator[tuple[str, bytes]]:
    """Frames of one trajectory, in order."""
    templates = Templates(FLOODED, pictures(16))
    for seq in range(2**52):
        yield templates.key, templates.message(seq)


def bad() -> Iterator[tuple[str, bytes]]:
    """Spoilt frames on the key that belongs to them."""
    mutants = spoilt_frames(FLOODED, Random(0))
    for i in range(2**52):
        yield frame_key(FLOODED), mutants[i % len(mutants)]


def strange() -> Iterator[tuple[str, bytes]]:
    """Spoilt frames, each under a name that never came before."""
    mutants = spoilt_frames(FLOODED, Random(0))
    for i in range(2**52):
        name = f"benchmark/nobody/{i}"
        yield f"koop/frame/{shard_of(name)}/{name}", mutants[i % len(mutants)]


def new() -> Iterator[tuple[str, bytes]]:
    """Good first frames, each of a trajectory that nobody knows yet."""
    template = "benchmark/new00000000"
    message = Templates(template, pictures(1)).message(0)
    for i in range(10**8):
        name = f"benchmark/new{i:08d}"
        yield frame_key(name), message.replace(template.encode(), name.encode())


_MAKERS: dict[int, Callable[[], Iterator[tuple[str, bytes]]]] = {
    GOOD: good,
    BAD: bad,
    STRANGE: strange,
    NEW: new,
}


def print_table(figures: dict[str, float], options: argparse.Namespace) -> None:
    print(
        f"{options.sources} sources at 20 Hz, frame put to a prediction that includes it [ms], "
        f"median of stretches of {STRETCH:g} s"
    )
    print(f"  {'flood of':10}{'quiet p50':>11}{'p99':>8}{'flood p50':>12}{'p99':>8}{'cost':>8}")
    for name in options.floods:
        times = [figures[f"{name}_{s}_p{p}_ms"] for s in ("quiet", "flood") for p in (50, 99)]
        print(
            f"  {name:10}{times[0]:11.1f}{times[1]:8.1f}{times[2]:12.1f}{times[3]:8.1f}"
            f"{figures[f'{name}_cost']:8.0%}  ({figures[f'{name}_cost_low']:.0%} to "
            f"{figures[f'{name}_cost_high']:.0%})   {figures[f'{name}_per_s']:.0f} a second"
        )
    print(
        f"  the cost is to be 20% at most; resident {figures['resident_mb']:.0f} MB, "
        f"{figures['lost']:.0f} messages were lost"
    )


if __name__ == "__main__":
    main()
