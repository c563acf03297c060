"""Test sets of small waves that travel through a window, and models that were never trained."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import torch

from koop_protocol import recording as names
from koop_service.encoding.architecture import Architecture
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.weights import EstimatorDefaults, ModelCard, save_weights
from koop_service.evaluation.fluid.cases import Case

CHANNELS, MEAN, SCALE = ("rho", "rho u", "rho v"), (1.0, 0.2, 0.0), (0.5, 0.1, 0.5)
SHAPE, WINDOW = (3, 16, 32), (-2.0, 10.0, -3.0, 3.0)
PERIOD, FREE_STREAM = 8, 0.25
DT, FRAME_TIME = 0.15, 0.8
FREE_PIXEL = (8, 5)  # row and column of (0, 0) in the window


def waves(frames: int, seed: int = 0, period: float = PERIOD) -> np.ndarray:
    """(frames, 3, 16, 32) float16, the pixel at (0, 0) with the free stream."""
    rng = np.random.default_rng(seed)
    t, y, x = np.ogrid[:frames, :16, :32]
    phases = rng.uniform(0, 6, 3)
    fields = [np.sin(2 * np.pi * (x / 32 - t / period) + p + 0.1 * y) for p in phases]
    frames_of = np.stack(fields, axis=1).astype(np.float16)
    frames_of[:, 1, *FREE_PIXEL] = (FREE_STREAM - MEAN[1]) / SCALE[1]
    return frames_of


def write_set(path: Path, case: Case, reynolds: float = 50.0) -> Path:
    """A test set as koop-dataset would have made it for `case`."""
    frames = waves(case.frames, seed=int(reynolds))
    controls = np.random.default_rng(1).normal(size=(1, case.frames - 1, int(case.wake.actuated)))
    states = np.sin(2 * np.pi * np.arange(case.frames) / PERIOD - 0.1)
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file[names.FRAMES_DATASET] = frames[None]
        file[names.CONTROLS_DATASET] = controls
        file[names.STATES_DATASET] = states[None, :, None]
        file[names.PARAMETERS_DATASET] = [json.dumps({"frame_time": FRAME_TIME})]
        file.attrs.update(
            {
                names.FORMAT_ATTRIBUTE: names.RECORDING_FORMAT,
                names.VERSION_ATTRIBUTE: names.RECORDING_VERSION,
                names.SYSTEM_ATTRIBUTE: "cylinder",
                names.RENDERER_ATTRIBUTE: "waves",
                names.DT_ATTRIBUTE: DT,
                names.SEED_ATTRIBUTE: 1000,
                names.CHANNELS_ATTRIBUTE: list(CHANNELS),
                names.CHANNEL_MEAN_ATTRIBUTE: MEAN,
                names.CHANNEL_SCALE_ATTRIBUTE: SCALE,
                names.WINDOW_ATTRIBUTE: WINDOW,
            }
        )
    return path


def write_model(path: Path, dynamics: str = "fitted", renderer: str = "waves") -> Path:
    """Untrained weights of 4 numbers; a learned B is of zeros."""
    path.parent.mkdir(parents=True, exist_ok=True)
    small = Architecture((8, 16), overlap=2)
    card = ModelCard(
        "cylinder",
        renderer,
        DT,
        4,
        SHAPE,
        EstimatorDefaults(history=1, rho=1e-4, forgetting=0.97),
        {"command": "koop-train x"},
        dynamics=dynamics,
        value_range=(-10.0, 10.0),
        architecture=small,
    )
    learned = None if dynamics == "fitted" else torch.zeros(4, 1)
    save_weights(path, initialised(4, 0, SHAPE, small), card, learned)
    return path
