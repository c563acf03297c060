"""What benchmarks of the service under load share: a model, a plain client, and pictures."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zenoh

from koop_protocol import Frame, encode, frame_key

SIZE = 64
RENDERER = "benchmark"
EPOCH = "0123456789abcdef"


def write_weights(folder: Path) -> Path:
    """Weights of the paper's size; what they have learned does not change how fast they are."""
    from koop_service.encoding.autoencoder import initialised
    from koop_service.encoding.weights import ModelCard, save_weights

    path = folder / "benchmark.safetensors"
    save_weights(path, initialised(8, seed=0), ModelCard("benchmark", "benchmark", 0.05))
    return path


@contextmanager
def client(endpoint: str) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 600_000_000,
    }.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


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

    def __init__(self, trajectory: str, images: np.ndarray) -> None:
        packed = [
            encode(Frame(trajectory, EPOCH, self.PLACEHOLDER, 0, image, "benchmark"))
            for image in images
        ]
        mark = self.PLACEHOLDER.to_bytes(8, "big")
        self.key = frame_key(trajectory)
        self._parts = [message.split(mark) for message in packed]

    def message(self, seq: int) -> bytes:
        head, tail = self._parts[seq % len(self._parts)]
        return head + seq.to_bytes(8, "big") + tail
