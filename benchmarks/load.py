"""What benchmarks put to a koop-serve: weights, pictures, frames packed beforehand, questions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import zenoh

from koop_protocol import ErrorReply, Frame, decode_as, encode, frame_key

SIZE = 64
PICTURES = 128
EPOCH = "0123456789abcdef"
RENDERER = "benchmark"
ANSWER_TIMEOUT = 60.0  # s
TREND_SAMPLES = 20
"""Fewest samples of which a trend is told."""


def write_weights(folder: Path) -> Path:
    """Weights of the paper's size; what they have learned does not change how fast they are."""
    from koop_service.encoding.autoencoder import initialised
    from koop_service.encoding.weights import ModelCard, save_weights

    path = folder / "benchmark.safetensors"
    save_weights(path, initialised(8, seed=0), ModelCard("benchmark", RENDERER, 0.05))
    return path


def models(weights: Path) -> tuple[str, str]:
    """Arguments of a koop-serve with these weights."""
    return "--models", f"benchmark/*={weights}"


def arguments(weights: Path) -> tuple[str, ...]:
    """Of one that tells of errors alone."""
    return (*models(weights), "--log-level", "error")


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
