"""What a kill of the service costs, and what it costs to be ready for one.

A source streams frames and controls of 1,000 trajectories as fast as the real `koop-serve` takes
them: with log and snapshots, and without, in turn.

Then it streams at 200 frames a second, with a log. The service is killed with SIGKILL ten times at
random moments and started again at once. It has caught up once every trajectory follows its source
again; that is timed from the moment it says that it is ready (and answers koop/health), and from
its process's start. In the end every trajectory's state is compared, bit for bit, with that of an
undisturbed fold of the same frames and controls.

    python benchmarks/durability.py                                  # the whole of it, some minutes
    python benchmarks/durability.py --rounds 0 --frames-per-s 300    # the kills alone, at this load
    python benchmarks/durability.py --kills 0 --rounds 8             # the cost alone
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import socket
import tempfile
import time
from contextlib import ExitStack, closing
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
from koop_serve import Service, service
from load import RENDERER, models, pictures, write_weights

from koop_clients.connection import flush, open_session
from koop_clients.replay.log import SourceLog
from koop_clients.sources import FrameSource
from koop_protocol import Control, Frame

PICTURES = 128
SNAPSHOTS = 3.0
"""koop-serve's default time between two snapshots [s]."""


def main() -> None:
    options = parse_options()
    with tempfile.TemporaryDirectory() as folder:
        weights = write_weights(Path(folder))
        figures = cost(options, Path(folder), weights) if options.rounds else {}
        if options.kills:
            figures |= under_fire(options, Path(folder), weights)
    print_table(options, figures)
    if options.json:
        print(json.dumps({name: round(value, 4) for name, value in figures.items()}))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trajectories", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=4, help="pairs of runs at full speed")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each of these")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--frames-per-s", type=float, default=200.0, help="while killed")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


# The source


def name_of(number: int) -> str:
    return f"benchmark/{number}"


def control_of(number: int, seq: int) -> np.ndarray:
    return np.array([np.sin(0.7 * seq + number)])


def stream(
    endpoint: str, log: Path | None, count: int, per_s: float, stop: Event, rounds: Any
) -> None:
    """Frames and controls of all trajectories in turn, until told to stop."""
    images = pictures(PICTURES)
    with ExitStack() as stack:
        session = stack.enter_context(open_session(endpoint, wait=60.0))
        kept = None if log is None else stack.enter_context(SourceLog(log))
        sources = [FrameSource(session, name_of(i), 1, RENDERER, log=kept) for i in range(count)]
        start, seq = time.monotonic(), 0
        while not stop.is_set():
            for number, source in enumerate(sources):
                time.sleep(max(0.0, start + (seq * count + number) / per_s - time.monotonic()))
                source.put_frame(images[(seq + number) % PICTURES])
                source.put_control(control_of(number, seq))
            seq += 1
            rounds.value = seq
        flush(session, 60.0)
        stop.clear()  # everything is put
        time.sleep(3600)  # and the log is served until this process is killed


class Source:
    """The process that streams."""

    def __init__(self, endpoint: str, log: Path | None, count: int, per_s: float) -> None:
        context = multiprocessing.get_context("spawn")
        self._stop, self._rounds = context.Event(), context.Value("q", 0)
        arguments = (endpoint, log, count, per_s, self._stop, self._rounds)
        self._process = context.Process(target=stream, args=arguments)
        self._process.start()

    @property
    def frames(self) -> int:
        """Put of each trajectory."""
        return self._rounds.value

    def stop(self) -> int:
        """Put no more; frames of each trajectory."""
        self._stop.set()
        while self._stop.is_set():
            time.sleep(0.05)
        return self.frames

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()


# Ten kills


def under_fire(options: argparse.Namespace, folder: Path, weights: Path) -> dict[str, float]:
    """Kill the service again and again, and see what became of every measurement."""
    per_s = options.frames_per_s
    count, choose = options.trajectories, np.random.default_rng(options.seed)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    starting, caught_up, replayed = [], [], []
    with ExitStack() as stack:
        for kill in range(options.kills + 1):
            started = time.monotonic()
            with service(folder / "state", *models(weights), listen=endpoint) as served:
                ready = time.monotonic()
                if not kill:
                    log = folder / "source.log"
                    source = stack.enter_context(Source(endpoint, log, count, per_s))
                await_following(served, count)
                if kill:
                    starting.append(ready - started)
                    caught_up.append(time.monotonic() - ready)
                    replayed.append(served.metric("koop_replayed_total"))
                    print_progress(kill, starting[-1], caught_up[-1], replayed[-1])
                if kill < options.kills:
                    time.sleep(choose.uniform(1.0, 6.0))
                    served.process.kill()
                else:
                    frames = source.stop()
                    await_quiet(served)
    return {
        "trajectories": count,
        "kills": options.kills,
        "load_frames_per_s": per_s,
        "measurements": 2 * frames * count,
        "starting_mean_s": float(np.mean(starting)),
        "catch_up_mean_s": float(np.mean(caught_up)),
        "catch_up_max_s": max(caught_up),
        "from_start_mean_s": float(np.mean(np.add(starting, caught_up))),
        "from_start_max_s": float(np.max(np.add(starting, caught_up))),
        "replayed_mean": float(np.mean(replayed)),
        **compared(folder, weights, count, frames),
    }


def await_following(served: Service, count: int) -> None:
    """Until every trajectory has caught up with its source's log."""
    while (
        served.metric("koop_catch_up_seconds_count") < count
        or served.metric("koop_catching_up") > 0
    ):
        time.sleep(0.1)  # each look costs the service some milliseconds


def await_quiet(served: Service) -> None:
    """Until nothing waits any more."""
    while served.metric("koop_queue_messages") or served.metric("koop_catching_up"):
        time.sleep(0.1)


def compared(folder: Path, weights: Path, count: int, frames: int) -> dict[str, float]:
    """The stored states against those of an undisturbed fold."""
    from koop_service.serving.durability.lmdb_store import LmdbStore
    from koop_service.serving.sharding.ownership import EVERY_SHARD
    from koop_service.serving.trajectories.sealing import unseal

    with closing(LmdbStore(folder / "state")) as store:
        records = {name: unseal(record) for name, record in store.load(EVERY_SHARD).items()}
    expected = undisturbed(weights, count, frames, {n: r["epoch"] for n, r in records.items()})
    counters = [record["stream"]["counters"] for record in records.values()]
    got = sum(c["frames"] + c["controls"] for c in counters)
    return {
        "lost": 2 * frames * count - got,
        "duplicated": sum(c["duplicates"] + c["late"] for c in counters),
        "identical": sum(same(records[name], expected[name]) for name in records),
    }


def undisturbed(
    weights: Path, count: int, frames: int, epochs: dict[str, str]
) -> dict[str, dict[str, Any]]:
    """Records of all trajectories after the same frames and controls, one after the other."""
    from koop_service.encoding.catalogue import Catalogue, ModelEntry
    from koop_service.serving.config import EstimatorChoices
    from koop_service.serving.instruments.metrics import Metrics
    from koop_service.serving.trajectories.records import snapshot_of
    from koop_service.serving.trajectories.refusals import Refusals
    from koop_service.serving.trajectories.registry import Registry

    entry = ModelEntry("benchmark", weights, ("*",))
    registry = Registry(Catalogue([entry]), EstimatorChoices(), Refusals(Metrics()), count)
    images = pictures(PICTURES)
    codes = registry.equipment(entry, 1)[0].encode(images)
    for number in range(count):
        name, trajectory = name_of(number), None
        for seq in range(frames):
            shown = (seq + number) % PICTURES
            frame = Frame(name, epochs[name], seq, 1, images[shown], RENDERER)
            trajectory = trajectory or registry.admit(frame)
            trajectory.fold_frame(frame, codes[shown])
            trajectory.fold_control(Control(name, epochs[name], seq, control_of(number, seq)))
            registry.update_estimators([trajectory])
    return {trajectory.name: snapshot_of(trajectory) for trajectory in registry}


def same(found: dict[str, Any], expected: dict[str, Any]) -> bool:
    """Whether no bit of the estimator or of the stream differs."""
    try:
        for part in ("lane", "stream"):
            np.testing.assert_equal(found[part], expected[part])
    except AssertionError:
        return False
    return True


def free_port() -> int:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# What it costs


def cost(options: argparse.Namespace, folder: Path, weights: Path) -> dict[str, float]:
    """Frames a second with and without, in turn, so that a drifting machine favours neither."""
    order = [True, False, False, True] * ((options.rounds + 1) // 2)
    rates: dict[bool, list[float]] = {True: [], False: []}
    for number, durable in enumerate(order[: 2 * options.rounds]):
        rates[durable].append(full_speed(options, folder / f"{number}", weights, durable))
    costs = 1.0 - np.array(rates[True]) / np.array(rates[False])
    return {
        "durable_frames_per_s": float(np.mean(rates[True])),
        "plain_frames_per_s": float(np.mean(rates[False])),
        "cost": float(np.mean(costs)),
        "cost_least": float(costs.min()),
        "cost_most": float(costs.max()),
    }


def full_speed(options: argparse.Namespace, folder: Path, weights: Path, durable: bool) -> float:
    """Frames a second that the service takes from a source that is as fast as it can be."""
    count = options.trajectories
    every = str(SNAPSHOTS if durable else 0)
    log = folder / "source.log" if durable else None
    with (
        service(folder / "state", *models(weights), "--snapshot-every", every) as served,
        Source(served.endpoint, log, count, np.inf),
    ):
        await_begun(served, count)
        start, before = time.monotonic(), served.metric("koop_frames_total")
        time.sleep(options.seconds)
        return (served.metric("koop_frames_total") - before) / (time.monotonic() - start)


def await_begun(served: Service, count: int) -> None:
    """Until all trajectories have begun, and nothing of their beginning is left to be read."""
    while served.metric("koop_frames_total") < 2 * count or served.metric("koop_catching_up"):
        time.sleep(0.1)


def print_progress(kill: int, starting: float, caught_up: float, replayed: float) -> None:
    print(
        f"kill {kill}: ready {starting:.1f} s after its start, caught up {caught_up:.2f} s later, "
        f"{replayed:.0f} messages replayed",
        flush=True,
    )


def print_table(options: argparse.Namespace, figures: dict[str, float]) -> None:
    rows = cost_rows(figures) if options.rounds else []
    if options.kills:
        rows += kill_rows(figures)
    print(f"{options.trajectories} trajectories, the service killed {options.kills} times")
    for name, value, goal in rows:
        print(f"  {name:28} {value:>20}   {goal}")


def cost_rows(figures: dict[str, float]) -> list[tuple[str, str, str]]:
    cost, least, most = (100 * figures[name] for name in ("cost", "cost_least", "cost_most"))
    return [
        ("frames/s, log and snapshots", f"{figures['durable_frames_per_s']:.0f}", ""),
        ("frames/s, neither", f"{figures['plain_frames_per_s']:.0f}", ""),
        ("cost", f"{cost:.0f} % ({least:.0f} to {most:.0f})", "under 15 %"),
    ]


def kill_rows(figures: dict[str, float]) -> list[tuple[str, str, str]]:
    total, count = figures["measurements"], figures["trajectories"]
    return [
        ("load, frames/s", f"{figures['load_frames_per_s']:.0f}", ""),
        ("lost", f"{figures['lost']:.0f} of {total:.0f}", "0"),
        ("duplicated", f"{figures['duplicated']:.0f}", "0"),
        ("states bit-identical", f"{figures['identical']:.0f} of {count:.0f}", "all"),
        ("caught up, ready for [s]", f"{figures['catch_up_mean_s']:.2f}", ""),
        ("  at worst [s]", f"{figures['catch_up_max_s']:.2f}", "under 2"),
        ("caught up, started for [s]", f"{figures['from_start_mean_s']:.2f}", ""),
        ("  at worst [s]", f"{figures['from_start_max_s']:.2f}", ""),
    ]


if __name__ == "__main__":
    main()
