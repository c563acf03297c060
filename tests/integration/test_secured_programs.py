"""The programs as a user starts them: koop-pki, koop-serve, koop-sim-client and koop-record."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from integration.loopback import DEADLINE

MODULES = {
    "koop-pki": "koop_clients.pki.cli",
    "koop-serve": "koop_service.cli",
    "koop-sim-client": "koop_clients.sim_client.cli",
    "koop-record": "koop_clients.recording.cli",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the deployment that the README makes, a recorder, and somebody who may only look on."""
    folder = tmp_path_factory.mktemp("programs")
    robot = "pendulum-actuated/0"
    run(folder, "koop-pki", "init")
    run(folder, "koop-pki", "add", "robot", "--publishes", robot, "--operates", robot)
    run(folder, "koop-pki", "add", "recorder", "--records", "**")
    run(folder, "koop-pki", "add", "wall", "--views", "**")
    return folder


@pytest.fixture(scope="module")
def endpoint(folder: Path) -> Iterator[str]:
    """Of a koop-serve with that deployment and the bundled models."""
    options = ["--zenoh-config", "pki/hub/zenoh.json5", "--state-folder", "state"]
    process = subprocess.Popen(
        [sys.executable, "-m", MODULES["koop-serve"], *options, "--listen", "tls/127.0.0.1:0"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert "ready on tls/127.0.0.1:" in line, line
        yield line.split()[-1]
    finally:
        process.kill()
        process.communicate()


def run(
    folder: Path, program: str, *options: str, code: int = 0
) -> subprocess.CompletedProcess[str]:
    """The program, from its folder, to its end with that exit code."""
    command = [sys.executable, "-m", MODULES[program], *options]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == code, done.stderr
    return done


def test_the_simulator_streams_and_is_driven(folder: Path, endpoint: str) -> None:
    """Where its commands bring it is a matter of models, and not of this test."""
    options = ["--connect", endpoint, "--zenoh-config", "pki/robot/zenoh.json5", "--json"]
    plan = ["--system", "pendulum", "--drive", "lqr", "--learn", "6", "--duration", "8"]
    done = run(folder, "koop-sim-client", *options, *plan, "--rate", "max", "--force")
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["frames"] == 160
    (drive,) = result["drives"]
    assert sum(drive["statuses"].values()) >= 35  # a command that meets a full queue is dropped
    assert drive["outcome"]["largest_torque"] > 0


def test_what_streams_is_predicted_and_recorded(folder: Path, endpoint: str) -> None:
    options = ["--connect", endpoint, "--zenoh-config", "pki/recorder/zenoh.json5"]
    options += ["--out", "robot.h5", "--frames", "20", "--trajectories", "1"]
    recorder = subprocess.Popen(
        [sys.executable, "-m", MODULES["koop-record"], *options],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert recorder.stderr is not None
    assert "Ctrl-C ends it" in recorder.stderr.readline()
    robot = ["--connect", endpoint, "--zenoh-config", "pki/robot/zenoh.json5", "--json"]
    plan = ["--system", "pendulum", "--actuated", "--duration", "5"]
    done = run(folder, "koop-sim-client", *robot, *plan, "--rate", "max")
    assert json.loads(done.stdout.splitlines()[-1])["predict"]["count"] > 0
    out, err = recorder.communicate(timeout=DEADLINE)
    assert recorder.returncode == 0, err
    assert "wrote robot.h5: 1 segments of 20 frames" in out


def test_who_may_not_publish_is_told_so(folder: Path, endpoint: str) -> None:
    options = ["--connect", endpoint, "--zenoh-config", "pki/wall/zenoh.json5"]
    plan = ["--system", "pendulum", "--duration", "2"]
    done = run(folder, "koop-sim-client", *options, *plan, code=1)
    assert "streamed 40 frames" in done.stdout
    assert "do not let this certificate publish it" in done.stderr.splitlines()[-1]
