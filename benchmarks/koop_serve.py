"""A real `koop-serve` for the benchmarks, alone or as workers: its metrics, memory and time."""

from __future__ import annotations

import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil


@dataclass
class Service:
    """A running one."""

    process: subprocess.Popen[str]
    endpoint: str
    metrics_port: int

    def resident(self) -> int:
        """Resident memory [bytes]."""
        return psutil.Process(self.process.pid).memory_info().rss

    def busy(self) -> float:
        """Processor time so far [s]."""
        return seconds_of(self.process)

    def metric(self, name: str) -> float:
        """A metric's value, summed over its labels."""
        return metric(self.metrics_port, name)


@dataclass(frozen=True)
class Worker:
    """One of several, as it said when it began to serve."""

    process: int
    metrics_port: int


@dataclass
class Team:
    """The workers behind one hub, and the file with everything that they said."""

    supervisor: subprocess.Popen[str]
    endpoint: str
    log: Path

    def workers(self) -> dict[int, Worker]:
        """Those that serve at present, by number."""
        serving = re.findall(_SERVES, self.log.read_text())
        return {int(number): Worker(int(pid), int(port)) for number, pid, port in serving}

    def spares(self) -> int:
        """How many have loaded since the start."""
        return self.log.read_text().count("a spare is ready")


_SERVES = r"worker (\d+)/\d+ serves .*\(process (\d+), metrics on port (\d+)\)"


def metric(port: int, name: str) -> float:
    """The value that a process serves on this port of this machine, summed over its labels."""
    url = f"http://127.0.0.1:{port}/metrics"
    text = urllib.request.urlopen(url, timeout=10).read().decode()
    values = re.findall(rf"^{name}(?:{{[^}}]*}})? (\S+)$", text, re.MULTILINE)
    return sum(float(value) for value in values)


def seconds_of(process: subprocess.Popen[str]) -> float:
    """Processor time of a process so far [s]."""
    times = psutil.Process(process.pid).cpu_times()
    return times.user + times.system


@contextmanager
def service(folder: Path, *arguments: str, listen: str = "tcp/127.0.0.1:0") -> Iterator[Service]:
    """By default on a free port of this machine, with its state in `folder`."""
    command = _command(folder, listen, *arguments)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield _started(process)
    finally:
        stop(process)


@contextmanager
def team(folder: Path, count: int, *arguments: str) -> Iterator[Team]:
    """So many workers, with their state and their log in `folder`."""
    folder.mkdir()
    log = folder / "log"
    command = _command(folder / "state", "tcp/127.0.0.1:0", "--workers", str(count), *arguments)
    with log.open("w") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
    try:
        assert process.stdout is not None
        told = (re.search(r"ready on (\S+)", line) for line in process.stdout)
        endpoint = next((found[1] for found in told if found), None)
        if endpoint is None:
            raise RuntimeError(f"koop-serve did not start: {log.read_text()}")
        yield Team(process, endpoint, log)
    finally:
        stop(process)


def stop(process: subprocess.Popen[str]) -> None:
    """End it as a user would; where that takes very long, by force, with subprocess's error."""
    process.terminate()
    try:
        process.wait(60)
    finally:
        process.kill()
        process.wait()


def _command(folder: Path, listen: str, *arguments: str) -> list[str]:
    return [
        *(sys.executable, "-m", "koop_service.cli", "--listen", listen),
        *("--state-folder", str(folder), "--metrics-port", "0", *arguments),
    ]


def _started(process: subprocess.Popen[str]) -> Service:
    endpoint = port = None
    assert process.stdout is not None
    for line in process.stdout:
        endpoint = endpoint or re.search(r"ready on (\S+)", line)
        port = port or re.search(r"metrics: port (\d+)", line)
        if endpoint and port:
            return Service(process, endpoint[1], int(port[1]))
    raise RuntimeError("koop-serve did not start")
