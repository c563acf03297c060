"""The real `koop-serve`, as a process: starting, stopping, coming back, and failing politely."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from integration.loopback import DEADLINE, Source, client, wait_until

from koop_protocol import PredictReply, StateReply, decode


@contextmanager
def serving(*options: object) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """(process, endpoint, everything printed until it was ready)."""
    command = [sys.executable, "-m", "koop_service.cli", *map(str, options)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)
    try:
        printed = ""
        while "try:" not in printed:
            line = process.stdout.readline()
            assert line, process.stderr.read()
            printed += line
        yield process, re.search(r"ready on (\S+)", printed)[1], printed
    finally:
        process.kill()
        process.communicate()


def run(*options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "koop_service.cli", *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE, check=False)


@pytest.fixture
def options(tmp_path: Path, model: Path) -> list[object]:
    return [
        *("--listen", "tcp/127.0.0.1:0", "--models", f"cart*={model}"),
        *("--state-folder", tmp_path / "state", "--log-format", "json"),
    ]


def stop(process: subprocess.Popen[str], number: int) -> str:
    """Signal it; its whole log."""
    process.send_signal(number)
    _, logged = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0, logged
    return logged


def test_it_stops_on_a_signal_and_continues_where_it_was(options: list[object]) -> None:
    with serving(*options) as (process, endpoint, _):
        with client(endpoint) as session:
            source = Source(session, "cart/0")
            source.stream(40)
            first = ask(session, "koop/predict/cart/0?horizon=10")
        assert isinstance(first, PredictReply)
        stop(process, signal.SIGTERM)
    with serving(*options) as (process, endpoint, printed):
        assert "continued from the last run: 1" in printed
        with client(endpoint) as session:
            again = ask(session, "koop/predict/cart/0?horizon=10")
            assert (again.codes == first.codes).all()
            source = Source(session, "cart/0")
            source.put(source.control(39))
            source.put(source.frame(40))
            state = ask(session, "koop/state/cart/0")
            assert isinstance(state, StateReply)
            assert (state.frames, state.updates) == (41, 39)
        stop(process, signal.SIGINT)


def test_it_stops_under_full_load(options: list[object]) -> None:
    with serving(*options) as (process, endpoint, _), client(endpoint) as session:
        source = Source(session, "cart/0", control_size=0)
        for seq in range(3000):
            source.put(source.frame(seq))
        stop(process, signal.SIGTERM)


def test_a_taken_port_is_explained(options: list[object]) -> None:
    with serving(*options) as (_, endpoint, _):
        result = run("--listen", endpoint, "--state-folder", options[-3])
    assert result.returncode == 1
    assert f"{endpoint} is already taken" in result.stderr
    assert "--listen" in result.stderr
    assert "Traceback" not in result.stderr


def test_it_waits_for_a_router_and_joins_it(options: list[object], tmp_path: Path) -> None:
    with serving(*options) as (_, endpoint, _):
        rest = [*options[2:4], "--state-folder", tmp_path / "other"]
        with (
            serving("--connect", endpoint, *rest) as (process, _, printed),
            client(endpoint) as session,
        ):
            assert "the routers it is connected to" in printed
            source = Source(session, "cart/0")
            source.stream(40)
            replies = list(session.get("koop/predict/cart/0", timeout=DEADLINE))
            assert any(reply.ok for reply in replies)
            stop(process, signal.SIGTERM)
    command = [sys.executable, "-m", "koop_service.cli", "--connect", endpoint, *map(str, rest)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert "waiting for it" in process.stderr.readline()
    stop(process, signal.SIGTERM)


def test_metrics_are_served_on_loopback(options: list[object]) -> None:
    with serving(*options, "--metrics-port", 0) as (process, endpoint, printed):
        port = re.search(r"metrics: port (\d+)", printed)[1]
        with client(endpoint) as session:
            source = Source(session, "cart/0")
            source.stream(40)
            source.put_raw("koop/frame/00/nonsense", b"nonsense")
            ask(session, "koop/predict/cart/0")
        # A prediction waits for its own trajectory's messages, and for nobody else's.
        rejected = 'koop_rejected_total{reason="malformed"} 1.0'
        wait_until(lambda: rejected in metrics_at(port), rejected)
        text = metrics_at(port)
        logged = stop(process, signal.SIGTERM)
    assert "koop_frames_total 40.0" in text
    assert "koop_controls_total 39.0" in text
    assert "koop_trajectories_ready 1.0" in text
    assert 'koop_query_seconds_count{kind="predict"}' in text
    assert "cart/0" not in text
    (line,) = [json.loads(line) for line in logged.splitlines() if "rejected" in line]
    assert (line["level"], line["reason"], line["trajectory"]) == (
        "warning",
        "malformed",
        "nonsense",
    )


def test_an_impossible_endpoint_is_explained(tmp_path: Path) -> None:
    result = run("--state-folder", tmp_path, "--listen", "tcp/256.0.0.1:1")
    assert result.returncode == 1
    assert "cannot open the Zenoh session on tcp/256.0.0.1:1" in result.stderr
    assert "Traceback" not in result.stderr


def metrics_at(port: str) -> str:
    return urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics").read().decode()


def ask(session, selector: str):
    (reply,) = session.get(selector, timeout=DEADLINE)
    return decode((reply.ok or reply.err).payload.to_bytes())
