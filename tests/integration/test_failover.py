"""Workers killed under load, as real processes: nothing is lost, and nobody answers twice."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh
from integration.loopback import (
    RENDERER,
    Source,
    ask_all,
    client,
    config_for,
    control,
    loop,
    picture,
    wait_until,
)

from koop_clients.queries import KoopClient, KoopError
from koop_clients.replay.log import SourceLog
from koop_clients.sources import FrameSource
from koop_protocol import PredictReply, StateReply, shard_of

COUNT, FRAMES, EPOCH = 3, 80, "00000000000000aa"
KILLED_AFTER = (45, 60)  # frames
PATIENCE = 120.0  # s for a process to load everything, on a machine that is busy
NAMES = [f"cart/{i}" for i in range(8)]


class Workers:
    """`koop-serve --workers`, and what it says."""

    def __init__(self, process: subprocess.Popen[str], log: Path) -> None:
        self.process = process
        self.log = log
        self.endpoint = ""

    def told(self, pattern: str) -> list[str]:
        return re.findall(pattern, self.log.read_text())

    def process_of(self, name: str) -> int:
        """The worker that has the trajectory, as its latest line says."""
        number = int(shard_of(name), 16) * COUNT // 64
        return int(self.told(rf"worker {number}/{COUNT} serves .*\(process (\d+)")[-1])

    def await_spare(self, count: int) -> None:
        """Until so many spares have loaded since the start."""
        deadline = time.monotonic() + PATIENCE
        while len(self.told("a spare is ready")) < count:
            assert time.monotonic() < deadline, self.log.read_text()
            time.sleep(0.05)

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(30)


@contextmanager
def workers(folder: Path, *options: object) -> Iterator[Workers]:
    command = [
        *(sys.executable, "-m", "koop_service.cli", "--workers", COUNT, "--batch", 4),
        *("--listen", "tcp/127.0.0.1:0", "--state-folder", folder / "state", *options),
    ]
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    log = folder / "log"
    with log.open("w") as errors:
        process = subprocess.Popen(
            [*map(str, command)], stdout=subprocess.PIPE, stderr=errors, text=True, env=places
        )
    team = Workers(process, log)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if "ready on" in line:
                team.endpoint = line.split()[-1]
                break
        assert team.endpoint, log.read_text()
        yield team
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory, model: Path) -> dict[str, PredictReply]:
    """What a service that nothing happens to predicts after the same frames."""
    with loop(config_for(tmp_path_factory.mktemp("undisturbed"), model)) as koop:
        for seed, name in enumerate(NAMES):
            Source(koop.session, name, seed, EPOCH).stream(FRAMES)
            # All at once would be too much: predictions by wildcard are refused then.
            found = state(koop.session, name)
            assert found is not None
            assert found.frames == FRAMES
        return answers(koop.session)


def answers(session: zenoh.Session) -> dict[str, PredictReply]:
    replies = ask_all(session, "koop/predict/**?horizon=9;return=codes,std")
    assert max(Counter(getattr(reply, "trajectory", "") for reply in replies).values()) == 1
    return {reply.trajectory: reply for reply in replies if isinstance(reply, PredictReply)}


def state(session: zenoh.Session, name: str) -> StateReply | None:
    try:
        return KoopClient(session).state(name)
    except KoopError:
        return None


@pytest.mark.timeout(300)
@pytest.mark.parametrize("engine", [(), ("--ray",)], ids=["processes", "ray"])
def test_a_worker_killed_under_load_leaves_no_trace(
    tmp_path: Path, model: Path, expected: dict[str, PredictReply], engine: tuple[str, ...]
) -> None:
    options = (*engine, "--models", f"cart*={model}", "--snapshot-every", 0.1)
    with ExitStack() as stack:
        team = stack.enter_context(workers(tmp_path, *options))
        session = stack.enter_context(client(team.endpoint))
        log = stack.enter_context(SourceLog(tmp_path / "source.log"))
        sources = [FrameSource(session, name, 1, RENDERER, log) for name in NAMES]
        answered: Counter[str] = Counter()
        for seq in range(FRAMES):
            for seed, source in enumerate(sources):
                source.epoch = EPOCH
                source.put_frame(picture(seed, seq))
                if seq < FRAMES - 1:
                    source.put_control(control(seed, seq))
            if seq in KILLED_AFTER:
                team.await_spare(1 + KILLED_AFTER.index(seq))
                os.kill(team.process_of(NAMES[0]), signal.SIGKILL)
                wait_until(lambda: state(session, NAMES[0]) is not None, "another one's answer")
            for reply in ask_all(session, "koop/state/**"):
                answered[f"{seq} {getattr(reply, 'trajectory', reply)}"] += 1
        for name in NAMES:
            wait_until(lambda name=name: getattr(state(session, name), "frames", 0) == FRAMES, name)
        found = answers(session)
        assert set(answered.values()) == {1}, "two workers answered for one trajectory"
        assert found.keys() == expected.keys() == set(NAMES)
        for name in NAMES:
            assert found[name].seq == expected[name].seq == FRAMES - 1
            np.testing.assert_array_equal(found[name].codes, expected[name].codes)
            np.testing.assert_array_equal(found[name].std, expected[name].std)
        assert len(team.told("ended with signal 9; another takes over")) == 2
        assert team.stop() == 0, team.log.read_text()


def test_workers_that_cannot_start_say_why_and_end(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_text("nothing")
    with (
        pytest.raises(AssertionError, match="cannot be read as safetensors") as told,
        workers(tmp_path, "--models", f"cart*={tmp_path / 'model.safetensors'}"),
    ):
        pass
    assert "could not start (exit code 1); stopping" in str(told.value)
    assert "Traceback" not in str(told.value)
