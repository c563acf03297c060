"""Real processes, killed with SIGKILL: the source, the service, and both at once."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import chain
from pathlib import Path

import numpy as np
import zenoh
from integration.loopback import DEADLINE, client, wait_until
from integration.player import played
from integration.test_process import serving
from integration.undisturbed import undisturbed

from koop_protocol import StateReply, decode, state_key
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.sharding.ownership import EVERY_SHARD
from koop_service.serving.trajectories.sealing import unseal

NAMES = ["cart/0", "cart/1"]


def test_whoever_is_killed_nothing_is_lost_and_no_bit_differs(tmp_path: Path, model: Path) -> None:
    endpoint, log = free_endpoint(), tmp_path / "source.log"
    options = [
        *("--listen", endpoint, "--models", f"cart*={model}", "--snapshot-every", 0.2),
        *("--state-folder", tmp_path / "state", "--forgetting", 0.95, "--window", 30),
    ]
    with serving(*options):
        with playing(endpoint, log):
            frames = await_frames(endpoint, 10)
        with playing(endpoint, log):
            frames = await_frames(endpoint, frames + 30)
    # Both were killed, one right after the other. Now only the service is.
    with ExitStack() as outlives:
        with serving(*options):
            source = outlives.enter_context(playing(endpoint, log))
            frames = await_frames(endpoint, frames + 30)
        with serving(*options) as (service, _, _):
            await_frames(endpoint, frames + 30)
            count = stop(source)
            await_frames(endpoint, count)
            service.send_signal(signal.SIGTERM)
            service.communicate(timeout=DEADLINE)
    assert_undisturbed(tmp_path / "state", model, count)


def assert_undisturbed(folder: Path, model: Path, count: int) -> None:
    with closing(LmdbStore(folder)) as store:
        records = {name: unseal(record) for name, record in store.load(EVERY_SHARD).items()}
    assert sorted(records) == NAMES  # a store has no order
    streams = (
        played(name, records[name]["epoch"], number, count) for number, name in enumerate(NAMES)
    )
    choices = EstimatorChoices(forgetting=0.95, window=30)
    expected = undisturbed(model, chain.from_iterable(streams), choices)
    for name, record in records.items():
        assert record["stream"]["counters"]["frames"] == count
        for part in ("stream", "lane", "epoch", "predecessors", "dtype", "rejected"):
            np.testing.assert_equal(record[part], expected[name][part])


def free_endpoint() -> str:
    """One that stays the same when the service comes back."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def playing(endpoint: str, log: Path) -> Iterator[subprocess.Popen[str]]:
    """The source; it is killed at the end."""
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "integration.player", endpoint, str(log), *NAMES]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=places)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def stop(source: subprocess.Popen[str]) -> int:
    """End its stream; how many frames of each trajectory there were."""
    assert source.stdin is not None
    assert source.stdout is not None
    source.stdin.write("stop\n")
    source.stdin.flush()
    return int(source.stdout.readline())


def await_frames(endpoint: str, count: int) -> int:
    """Until the service has so many frames of each trajectory, or more; how many then."""
    found: list[int] = []

    def are_there() -> bool:
        found[:] = next_seqs(session)
        return len(found) == len(NAMES) and min(found) >= count

    with client(endpoint) as session:
        wait_until(are_there, f"frame {count} of all")
    return max(found)


def next_seqs(session: zenoh.Session) -> list[int]:
    """The next frame that the service expects of each trajectory, where it answers."""
    replies = chain.from_iterable(session.get(state_key(name), timeout=1.0) for name in NAMES)
    states = [decode(reply.ok.payload.to_bytes()) for reply in replies if reply.ok]
    return [state.next_seq for state in states if isinstance(state, StateReply)]
