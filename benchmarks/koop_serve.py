"""A real `koop-serve` in a process of its own, for the benchmarks: its metrics, memory and time."""

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
        url = f"http://127.0.0.1:{self.metrics_port}/metrics"
        text = urllib.request.urlopen(url, timeout=10).read().decode()
        values = re.findall(rf"^{name}(?:{{[^}}]*}})? (\S+)$", text, re.MULTILINE)
        return sum(float(value) for value in values)


def seconds_of(process: subprocess.Popen[str]) -> float:
    """Processor time of a process so far [s]."""
    times = psutil.Process(process.pid).cpu_times()
    return times.user + times.system


@contextmanager
def service(folder: Path, *arguments: str) -> Iterator[Service]:
    """Listening on a free port of this machine, with its state in `folder`."""
    command = [
        *(sys.executable, "-m", "koop_service.cli", "--listen", "tcp/127.0.0.1:0"),
        *("--state-folder", str(folder), "--metrics-port", "0", *arguments),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield _started(process)
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


def _started(process: subprocess.Popen[str]) -> Service:
    endpoint = port = None
    assert process.stdout is not None
    for line in process.stdout:
        endpoint = endpoint or re.search(r"ready on (\S+)", line)
        port = port or re.search(r"metrics: port (\d+)", line)
        if endpoint and port:
            return Service(process, endpoint[1], int(port[1]))
    raise RuntimeError("koop-serve did not start")
