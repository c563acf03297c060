"""The real koop-serve as a process of its own, and what benchmarks put to it."""

from __future__ import annotations

import re
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import zenoh

from koop_protocol import ErrorReply, Frame, decode_as, encode, frame_key

SIZE = 64
PICTURES = 128
EPOCH = "0123456789abcdef"
RENDERER = "benchmark"
ANSWER_TIMEOUT = 60.0  # s
TREND_SAMPLES = 20
"""Fewest samples of which a trend is told."""


@dataclass
class Service:
    """A running koop-serve. Without metrics, `metrics_port` is 0."""

    process: subprocess.Popen[str]
    endpoint: str
    metrics_port: int = 0

    def resident(self) -> int:
        """Resident memory [bytes]."""
        return psutil.Process(self.process.pid).memory_info().rss

    def metric(self, name: str) -> float:
        """A metric's value, summed over its labels."""
        return sum(self.metrics(name).values())

    def metrics(self, name: str) -> dict[str, float]:
        """A metric's values by their labels."""
        url = f"http://127.0.0.1:{self.metrics_port}/metrics"
        text = urllib.request.urlopen(url, timeout=10).read().decode()
        found = re.findall(rf"^{name}(?:{{([^}}]*)}})? (\S+)$", text, re.MULTILINE)
        return {labels: float(value) for labels, value in found}


@contextmanager
def serving(folder: Path, *options: object, metrics: bool = True) -> Iterator[Service]:
    """koop-serve on any free port, its state in `folder`, until the context ends."""
    command = [
        *(sys.executable, "-m", "koop_service.cli", "--listen", "tcp/127.0.0.1:0"),
        *("--state-folder", str(folder / "state"), "--log-level", "error"),
        *(("--metrics-port", "0") if metrics else ()),
        *map(str, options),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield _started(process, metrics)
    finally:
        stop(process)


def stop(process: subprocess.Popen[str]) -> None:
    """End it as a user would; where that takes very long, by force, and say so."""
    process.terminate()
    try:
        process.wait(60)
    finally:
        process.kill()
        process.wait()


def _started(process: subprocess.Popen[str], metrics: bool) -> Service:
    endpoint = port = None
    assert process.stdout is not None
    for line in process.stdout:
        endpoint = endpoint or re.search(r"ready on (\S+)", line)
        port = port or re.search(r"metrics: port (\d+)", line)
        if endpoint and (port or not metrics):
            return Service(process, endpoint[1], int(port[1]) if port else 0)
    raise RuntimeError("koop-serve did not start")


def write_weights(folder: Path) -> Path:
    """Weights of the paper's size; what they have learned does not change how fast they are."""
    from koop_service.encoding.autoencoder import initialised
    from koop_service.encoding.weights import ModelCard, save_weights

    path = folder / "benchmark.safetensors"
    save_weights(path, initialised(8, seed=0), ModelCard("benchmark", RENDERER, 0.05))
    return path


def pictures(count: int) -> np.ndarray:
    """A cart with its pole, (count, 64, 64) uint8, prepared before anything is timed."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE - 0.5
    return np.stack([_picture(x, y, 0.1 * i) for i in range(count)])


def _picture(x: np.ndarray, y: np.ndarray, phase: float) -> np.ndarray:
    position, angle = 0.2 * np.sin(phase), 1.3 * np.cos(0.7 * phase)
    u, v = x - position, y
    along = np.clip(u * np.sin(angle) - v * np.cos(angle), 0.0, 0.35)
    pole = np.hypot(u - along * np.sin(angle), v + along * np.cos(angle)) - 0.03
    cart = np.maximum(abs(u) - 0.1, abs(v) - 0.04)
    return np.clip(255 * (0.5 - SIZE * np.minimum(pole, cart)), 0, 255).astype(np.uint8)


class Templates:
    """Frames packed beforehand; only the number in them is written anew at each put."""

    PLACEHOLDER = 2**52 + 1

    def __init__(self, trajectory: str, images: np.ndarray, renderer: str = RENDERER) -> None:
        packed = [
            encode(Frame(trajectory, EPOCH, self.PLACEHOLDER, 0, image, renderer))
            for image in images
        ]
        mark = self.PLACEHOLDER.to_bytes(8, "big")
        self.key = frame_key(trajectory)
        self._parts = [message.split(mark) for message in packed]

    def message(self, seq: int) -> bytes:
        """Frame `seq`."""
        head, tail = self._parts[seq % len(self._parts)]
        return head + seq.to_bytes(8, "big") + tail


def ask(
    session: zenoh.Session,
    selector: str,
    payload: bytes | None,
    answered: Callable[[str], None],
) -> None:
    """Ask without waiting; `answered` gets the error's code, or "", from one of Zenoh's threads."""

    def take(reply: zenoh.Reply) -> None:
        err = reply.err
        answered("" if err is None else decode_as(ErrorReply, err.payload.to_bytes()).code)

    handler = zenoh.handlers.Callback(take, indirect=False)
    session.get(selector, handler, payload=payload, timeout=ANSWER_TIMEOUT)


def growth(resident: list[tuple[float, int]]) -> float:
    """Slope of (time [s], memory [bytes]) over the second half [bytes/min]; 0 of a few samples."""
    half = np.array(resident[len(resident) // 2 :], dtype=float)
    if len(half) < TREND_SAMPLES // 2:
        return 0.0
    return 60.0 * float(np.polyfit(half[:, 0], half[:, 1], 1)[0])
