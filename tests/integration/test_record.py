"""`koop-record` as a process: what sources put is what training reads, also after a kill -9."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh
from integration.loopback import DEADLINE, client, control, picture, wait_until

from koop_clients.sources import FrameSource
from koop_service.learning.recording import load_manifest, load_recording
from koop_service.serving.config import NetworkSettings
from koop_service.serving.session import locators, open_session

LENGTH = 20  # frames of a segment
COMMAND = [sys.executable, "-m", "koop_clients.recording.cli"]


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A hub that is neither service nor recorder."""
    with open_session(NetworkSettings(listen=("tcp/127.0.0.1:0",))) as hub:
        yield locators(hub)[0]


@pytest.fixture
def session(endpoint: str) -> Iterator[zenoh.Session]:
    with client(endpoint) as opened:
        yield opened


@contextmanager
def recording(endpoint: str, out: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """A recorder past its subscriptions."""
    options = ("--out", str(out), "--connect", endpoint, "--frames", str(LENGTH), *options)
    pipe = subprocess.PIPE
    process = subprocess.Popen([*COMMAND, *options], stdout=pipe, stderr=pipe, text=True)
    try:
        line = process.stderr.readline()
        assert "Ctrl-C ends it" in line, line + process.stderr.read()
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen[str], number: int | None = None) -> tuple[str, str]:
    """Signal it, if need be; what it printed."""
    if number is not None:
        process.send_signal(number)
    out, err = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0, err
    return out, err


def stream(
    session: zenoh.Session, name: str, seed: int, frames: int, read: bool = True, **options
) -> None:
    """Frames and controls that the seed determines, through the class that cameras use."""
    with FrameSource(session, name, **options) as source:
        if read:
            await_reader(source)
        for seq in range(frames):
            source.put_frame(picture(seed, seq))
            if source.control_size:
                source.put_control(control(seed, seq))


def await_reader(source: FrameSource) -> None:
    """Until the source's own session knows of the recorder: what it puts before goes nowhere."""
    for publisher in (source._frames, source._controls):
        wait_until(lambda publisher=publisher: publisher.matching_status.matching, "a reader")


def pictures(seed: int, start: int) -> np.ndarray:
    return np.stack([picture(seed, start + i) for i in range(LENGTH)])


def assert_what_was_sent(path: Path, seeds: dict[str, int]) -> list[tuple[str, int]]:
    """Frames and controls are those of the manifest's trajectory and number; which those are."""
    found, manifest = load_recording(path), load_manifest(path)
    for frames, controls, entry in zip(found.frames, found.controls, manifest, strict=True):
        seed, start = seeds[entry["trajectory"]], entry["seq"]
        assert np.array_equal(frames, pictures(seed, start))
        sent = [control(seed, start + i) for i in range(LENGTH - 1)]
        assert np.array_equal(controls, np.array(sent)[:, : controls.shape[1]])
    return [(entry["trajectory"], entry["seq"]) for entry in manifest]


def test_what_two_sources_put_is_what_training_reads(
    endpoint: str, session: zenoh.Session, tmp_path: Path
) -> None:
    out = tmp_path / "a.h5"
    with recording(endpoint, out, "--trajectories", "4", "--dt", "0.05") as process:
        for seed, name in enumerate(("rig/0", "rig/1")):
            stream(session, name, seed, 2 * LENGTH + 1, control_size=1, renderer="r")
        printed, _ = ended(process)
    assert re.search(r"\d+ frames came; 4 segments of 20 frames from 2 trajectories", printed)
    assert "wrote" in printed
    kept = assert_what_was_sent(out, {"rig/0": 0, "rig/1": 1})
    assert kept == [("rig/0", 0), ("rig/0", 20), ("rig/1", 0), ("rig/1", 20)]
    found = load_recording(out)
    assert (found.system, found.renderer, found.dt) == ("rig", "r", 0.05)
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_a_signal_ends_it_and_only_what_was_asked_for_is_recorded(
    endpoint: str, session: zenoh.Session, tmp_path: Path
) -> None:
    out = tmp_path / "a.h5"
    options = ("koop/frame/*/camera/**", "--system", "crane", "--dt", "0.04")
    with recording(endpoint, out, *options) as process:
        stream(session, "other/0", 5, LENGTH, read=False)
        stream(session, "camera/wide", 6, LENGTH + 4)
        with FrameSource(session, "camera/large") as source:
            await_reader(source)
            source.put_frame(np.zeros((48, 64), np.uint8))
        session.put("koop/frame/00/camera/odd", b"no message")
        segments = out.with_name("a.h5.segments")
        wait_until(lambda: any(segments.glob("*.h5")), "a segment")
        refused = [process.stderr.readline() for _ in range(2)]
        printed, _ = ended(process, signal.SIGTERM)
    assert "refused 'camera/large': its images are (48, 64); expected (64, 64)" in refused[0]
    assert "ignored what came on koop/frame/00/camera/odd" in refused[1]
    assert "not kept: 4 cut short by the end, 1 refused, 1 unreadable" in printed
    assert assert_what_was_sent(out, {"camera/wide": 6}) == [("camera/wide", 0)]
    found = load_recording(out)
    assert (found.system, found.dt, found.controls.shape) == ("crane", 0.04, (1, LENGTH - 1, 0))


def test_a_killed_recording_keeps_its_whole_segments(
    endpoint: str, session: zenoh.Session, tmp_path: Path
) -> None:
    out = tmp_path / "a.h5"
    segments = out.with_name("a.h5.segments")
    with recording(endpoint, out) as process:
        with FrameSource(session, "rig/0", control_size=1) as source:
            for seq in range(100_000):
                source.put_frame(picture(0, seq))
                source.put_control(control(0, seq))
                if len(list(segments.glob("*.h5"))) >= 3:
                    break
            process.send_signal(signal.SIGKILL)  # in the middle of whatever it does
        process.wait(DEADLINE)
        before = len(list(segments.glob("*.h5")))
    refused = run("--out", str(out), "--connect", endpoint)
    assert refused.returncode == 1
    assert f"--recover --out {out}" in refused.stderr
    recovered = run("--recover", "--out", str(out), "--dt", "0.05")
    assert recovered.returncode == 0, recovered.stderr
    assert f"{before} segments of 20 frames" in recovered.stdout
    kept = assert_what_was_sent(out, {"rig/0": 0})
    assert kept == [("rig/0", LENGTH * i) for i in range(before)]
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_where_no_service_runs_it_is_the_hub(tmp_path: Path) -> None:
    out = tmp_path / "a.h5"
    with socket.create_server(("127.0.0.1", 0)) as probe:
        free = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    options = ["--out", str(out), "--listen", free, "--frames", "20", "--trajectories", "1"]
    process = subprocess.Popen([*COMMAND, *options], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        assert f"from {free}" in process.stderr.readline()
        with client(free) as session:
            stream(session, "rig/0", 3, LENGTH)
        _, err = process.communicate(timeout=DEADLINE)
        assert process.returncode == 0, err
    finally:
        process.kill()
        process.communicate()
    assert assert_what_was_sent(out, {"rig/0": 3}) == [("rig/0", 0)]


def test_nothing_recorded_is_said_and_leaves_nothing(endpoint: str, tmp_path: Path) -> None:
    result = run("--out", str(tmp_path / "a.h5"), "--connect", endpoint, "--duration", "0.3")
    assert result.returncode == 1
    assert "no frame came on koop/frame/**; is a source connected to" in result.stderr
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (["koop/control/**"], 2, "'koop/control/**' is no key of frames; expected one like"),
        (["koop/frame/**/"], 2, "is no key of frames"),
        (["--frames", "1"], 2, "--frames is 1; expected 2 or more"),
        (["--dt", "0"], 2, "--dt is 0.0; expected above 0"),
        (
            ["--listen", "tcp/127.0.0.1:1", "--connect", "tcp/127.0.0.1:1"],
            2,
            "--listen makes a hub",
        ),
        (["--connect", "tcp/127.0.0.1:1", "--wait", "0"], 1, "nobody listens on tcp/127.0.0.1:1"),
        (["--recover"], 1, "there is no segment to recover in"),
    ],
)
def test_what_makes_no_sense_is_refused(
    tmp_path: Path, options: list[str], status: int, words: str
) -> None:
    result = run(*options, "--out", str(tmp_path / "a.h5"))
    assert result.returncode == status
    assert words in result.stderr
    assert "Traceback" not in result.stderr


def run(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *options], capture_output=True, text=True, timeout=DEADLINE, check=False
    )
