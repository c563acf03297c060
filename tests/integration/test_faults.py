"""Real processes under what happens to them short of a kill: stopped, cut off, short of disk.

However it is disturbed, the state is that of an undisturbed stream, bit for bit.
"""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from integration.bystander import bystander
from integration.loopback import DEADLINE, client, wait_until
from integration.test_kill import (
    NAMES,
    assert_undisturbed,
    await_frames,
    free_endpoint,
    playing,
    stop,
)
from integration.test_process import serving

from koop_clients.queries import KoopClient
from koop_protocol.lifecycle import NOT_DURABLE
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.sharding.ownership import EVERY_SHARD

Process = subprocess.Popen[str]

STOPPED = 3.0  # s
JUMPING = """
import time
real, real_ns = time.time, time.time_ns
jump = lambda: 365 * 86400 * (1 if time.monotonic() % 1.0 < 0.5 else -1)
time.time = lambda: real() + jump()
time.time_ns = lambda: real_ns() + jump() * 10**9
"""
"""Read by Python at its start: a wall clock that is a year ahead, then a year behind, by turns."""


class Stage:
    """A service and its source, on this endpoint, with these files."""

    def __init__(self, folder: Path, model: Path) -> None:
        self.endpoint = free_endpoint()
        self.folder, self.model = folder, model
        self.log = folder / "source.log"

    @contextmanager
    def serving(self, *options: object, network: str = "--listen") -> Iterator[Process]:
        """The service; at its end what it holds is on the disk."""
        own = [
            *(network, self.endpoint, "--models", f"cart*={self.model}", "--snapshot-every", 0.2),
            *("--state-folder", self.folder / "state", "--forgetting", 0.95, "--window", 30),
        ]
        with serving(*own, *options) as (process, _, _):
            yield process

    def finish(self, service: Process, source: Process) -> None:
        """End the stream and the service, and compare."""
        count = stop(source)
        await_frames(self.endpoint, count)
        service.send_signal(signal.SIGTERM)
        service.communicate(timeout=DEADLINE)
        assert_undisturbed(self.folder / "state", self.model, count)


@pytest.fixture
def stage(tmp_path: Path, model: Path) -> Stage:
    return Stage(tmp_path, model)


@contextmanager
def suspended(process: Process) -> Iterator[None]:
    process.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        process.send_signal(signal.SIGCONT)


@pytest.mark.parametrize("who", ["service", "source"])
def test_one_that_stands_still_goes_on(stage: Stage, who: str) -> None:
    with stage.serving() as service, playing(stage.endpoint, stage.log) as source:
        frames = await_frames(stage.endpoint, 10)
        with suspended(service if who == "service" else source):
            time.sleep(STOPPED)
        await_frames(stage.endpoint, frames + 30)
        stage.finish(service, source)


def test_a_reader_that_stands_still_costs_nothing(stage: Stage) -> None:
    """It has subscribed to everything, frames as well: what it does not take fills its link."""
    with (
        stage.serving() as service,
        bystander("reader", stage.endpoint) as reader,
        playing(stage.endpoint, stage.log) as source,
    ):
        frames = await_frames(stage.endpoint, 10)
        with suspended(reader):
            await_frames(stage.endpoint, frames + 200)
        stage.finish(service, source)


def test_a_router_that_is_killed_and_comes_back(stage: Stage) -> None:
    with ExitStack() as outlive, bystander("router", stage.endpoint) as router:
        service = outlive.enter_context(stage.serving(network="--connect"))
        source = outlive.enter_context(playing(stage.endpoint, stage.log))
        frames = await_frames(stage.endpoint, 10)
        router.kill()
        router.wait()
        time.sleep(STOPPED)
        with bystander("router", stage.endpoint):
            await_frames(stage.endpoint, frames + 30)
            stage.finish(service, source)


def test_a_full_disk_is_told_and_forgotten(stage: Stage) -> None:
    """No file of the service can grow for a while; until then it goes on, and says so."""
    with stage.serving() as service, playing(stage.endpoint, stage.log) as source:
        frames = await_frames(stage.endpoint, 10)
        with client(stage.endpoint) as session:
            koop = KoopClient(session, DEADLINE)

            def is_durable() -> bool:
                return NOT_DURABLE not in koop.health()[0].degraded

            limits = resource.prlimit(service.pid, resource.RLIMIT_FSIZE)
            resource.prlimit(service.pid, resource.RLIMIT_FSIZE, (0, limits[1]))
            wait_until(lambda: not is_durable(), "the news that nothing is stored")
            frames = await_frames(stage.endpoint, frames + 30)
            resource.prlimit(service.pid, resource.RLIMIT_FSIZE, limits)
            wait_until(is_durable, "a snapshot after that")
        stage.finish(service, source)


def test_a_log_torn_by_a_crash_goes_on_from_what_is_sound(stage: Stage) -> None:
    """The last pages of a log that was being written are not there, or are nonsense."""
    with stage.serving() as service:
        with playing(stage.endpoint, stage.log):
            frames = await_frames(stage.endpoint, 30)
        wal = stage.log.with_name(stage.log.name + "-wal")
        data = wal.read_bytes()
        wal.write_bytes(data[: -len(data) // 3] + bytes(1000))
        with playing(stage.endpoint, stage.log) as source:
            await_frames(stage.endpoint, frames + 30)
            stage.finish(service, source)


@pytest.fixture
def jumping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall clock of all processes that are started from now on."""
    folder = tmp_path / "jumping"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(JUMPING)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    command = [sys.executable, "-c", "import time; print(time.time())"]
    shown = float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert abs(shown - time.time()) > 300 * 86400


@pytest.mark.usefixtures("jumping")
def test_clocks_that_jump(stage: Stage) -> None:
    """Each process is also killed and started anew, whatever the time is then."""
    with stage.serving(), playing(stage.endpoint, stage.log):
        frames = await_frames(stage.endpoint, 30)
    with stage.serving("--evict-after", 1) as service:
        with playing(stage.endpoint, stage.log):
            frames = await_frames(stage.endpoint, frames + 60)
        with playing(stage.endpoint, stage.log) as source:
            await_frames(stage.endpoint, frames + 60)
            stage.finish(service, source)


def test_a_damaged_snapshot_is_set_aside(stage: Stage) -> None:
    with stage.serving(), playing(stage.endpoint, stage.log):
        await_frames(stage.endpoint, 30)
    file = stage.folder / "state" / "estimators.lmdb"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 4] + b"\xff" * (len(data) - len(data) // 4))
    with stage.serving() as service, playing(stage.endpoint, stage.log):
        await_frames(stage.endpoint, 30)
        service.send_signal(signal.SIGTERM)
        _, logged = service.communicate(timeout=DEADLINE)
    (aside,) = file.parent.glob("*.unfit")
    assert "it is kept as " + aside.name in logged
    with closing(LmdbStore(file.parent)) as store:
        assert len(store.load(EVERY_SHARD)) == len(NAMES)
