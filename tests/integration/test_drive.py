"""The simulator client under the real service's commands: `koop-serve` and `--drive`, small."""

from __future__ import annotations

import json
import queue
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from integration.loopback import DEADLINE, client

from koop_protocol import Command, EndReason, LqrEnd, Message, decode


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Of a koop-serve with its own models."""
    folder = tmp_path_factory.mktemp("state")
    options = ["--listen", "tcp/127.0.0.1:0", "--state-folder", str(folder)]
    process = subprocess.Popen(
        [sys.executable, "-m", "koop_service.cli", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if "ready on" in line:
                yield line.split()[-1]
                break
        else:
            raise AssertionError("koop-serve did not start")
    finally:
        process.kill()
        process.communicate()


def options(endpoint: str, *more: str) -> list[str]:
    module = "koop_clients.sim_client.cli"
    given = ["--connect", endpoint, "--system", "pendulum", "--json", *more]
    return [sys.executable, "-m", module, *given]


def simulate(endpoint: str, *more: str) -> dict[str, Any]:
    run = subprocess.run(
        options(endpoint, *more), capture_output=True, text=True, timeout=100, check=False
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.parametrize("drive", ["lqr", "mpc"])
def test_the_commands_reach_the_plants(endpoint: str, drive: str) -> None:
    """Two plants; whether they get upright is a matter of models, and not of this test."""
    first = "0" if drive == "lqr" else "10"
    times = ("--learn", "6", "--duration", "8", "--rate", "max", "--force")
    result = simulate(endpoint, "--drive", drive, "--trajectories", "2", "--first", first, *times)
    assert result["totals"]["driven"] == 2
    for found in result["drives"]:
        assert found["began"] == pytest.approx(6.0)
        assert found["seconds"] == pytest.approx(2.0)
        # A command that meets a full queue is dropped.
        assert sum(found["statuses"].values()) >= 35
        assert found["outcome"]["largest_torque"] > 0
    assert result["totals"]["command"]["count"] >= 70


def test_a_slow_camera_is_compensated_for(endpoint: str) -> None:
    times = ("--learn", "6", "--duration", "8", "--rate", "max", "--force", "--delay", "0.1")
    result = simulate(endpoint, "--drive", "mpc", "--first", "20", *times)
    (found,) = result["drives"]
    assert found["delay"] == 2
    assert found["began"] == pytest.approx(6.0)


def test_a_client_that_dies_ends_its_task(endpoint: str) -> None:
    times = ("--learn", "3", "--duration", "60", "--force")
    process = subprocess.Popen(
        options(endpoint, "--drive", "mpc", "--first", "30", *times),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    seen: queue.Queue[Message] = queue.Queue()
    with client(endpoint) as session:
        subscriber = session.declare_subscriber(
            "koop/command/pendulum-actuated/30",
            lambda sample: seen.put(decode(bytes(sample.payload))),
        )
        command = seen.get(timeout=DEADLINE)
        assert isinstance(command, Command)
        process.send_signal(signal.SIGKILL)
        process.wait()
        while isinstance(end := seen.get(timeout=DEADLINE), Command):
            pass
        assert isinstance(end, LqrEnd)
        assert (end.owner, end.reason) == (command.owner, EndReason.owner_gone)
        subscriber.undeclare()
