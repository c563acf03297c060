"""A small recording of a rotation, and the quickest of trainings."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from koop_protocol import recording as names
from koop_service.learning.presets import PRESETS, Preset


def moving_blobs(count: int = 3, frames: int = 70) -> np.ndarray:
    """A bright square on a circle (count, frames, 64, 64) uint8, its speed different in each."""
    images = np.zeros((count, frames, 64, 64), np.uint8)
    for i in range(count):
        for t in range(frames):
            x, y = (32 + 20 * f((0.2 + 0.02 * i) * t + i) for f in (np.cos, np.sin))
            images[i, t, int(y) - 4 : int(y) + 4, int(x) - 4 : int(x) + 4] = 255
    return images


def pushes(frames: np.ndarray, size: int = 1) -> np.ndarray:
    """Controls (N, T-1, p) that do nothing in particular."""
    shape = (frames.shape[0], frames.shape[1] - 1, size)
    return np.random.default_rng(0).normal(size=shape)


def write(path: Path, frames: np.ndarray, controls: np.ndarray, **attributes: Any) -> Path:
    """A recording."""
    with h5py.File(path, "w") as file:
        file[names.FRAMES_DATASET] = frames
        file[names.CONTROLS_DATASET] = controls
        known = {
            names.FORMAT_ATTRIBUTE: names.RECORDING_FORMAT,
            names.VERSION_ATTRIBUTE: names.RECORDING_VERSION,
            names.SYSTEM_ATTRIBUTE: "blobs",
            names.RENDERER_ATTRIBUTE: "test",
            names.DT_ATTRIBUTE: 0.05,
            names.SEED_ATTRIBUTE: 0,
        }
        file.attrs.update({**known, **attributes})
    return path


def smoke(warm_up: int = 3, steps: int = 3, **changes: Any) -> Preset:
    """The preset smoke with fewer steps, and other changes."""
    preset = dataclasses.replace(PRESETS["smoke"], **changes)
    return dataclasses.replace(
        preset,
        autoencoder=dataclasses.replace(preset.autoencoder, steps=warm_up),
        dynamics=dataclasses.replace(preset.dynamics, steps=steps),
    )
