"""Reading koop recordings (HDF5), with clear errors for files that do not fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  (registers the Zstandard filter)
import numpy as np
from koop_protocol import recording as names

from koop_service.encoding.autoencoder import IMAGE_SIZE


@dataclass(frozen=True, eq=False)
class Recording:
    """N trajectories of T frames in memory.

    `frames` (N, T, 64, 64) uint8; `controls` (N, T-1, p), control k acting between frames k and
    k+1; `dt` the frame interval [s].
    """

    frames: np.ndarray
    controls: np.ndarray
    system: str
    renderer: str
    dt: float
    seed: int


def load_recording(path: Path) -> Recording:
    """Read `path` whole. Raises ValueError saying what is wrong with it."""
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path} cannot be read as HDF5: {error}") from error
    with file:
        _check(path, file)
        attributes = file.attrs
        return Recording(
            frames=file[names.FRAMES_DATASET][:],
            controls=file[names.CONTROLS_DATASET][:],
            system=str(attributes[names.SYSTEM_ATTRIBUTE]),
            renderer=str(attributes[names.RENDERER_ATTRIBUTE]),
            dt=float(attributes[names.DT_ATTRIBUTE]),
            seed=int(attributes[names.SEED_ATTRIBUTE]),
        )


def _check(path: Path, file: h5py.File) -> None:
    if file.attrs.get(names.FORMAT_ATTRIBUTE) != names.RECORDING_FORMAT:
        raise ValueError(f"{path} is not a koop recording; make one with koop-dataset")
    version = int(file.attrs[names.VERSION_ATTRIBUTE])
    if version != names.RECORDING_VERSION:
        raise ValueError(
            f"{path} is a recording of version {version}; this koop reads "
            f"{names.RECORDING_VERSION}"
        )
    frames, controls = file[names.FRAMES_DATASET], file[names.CONTROLS_DATASET]
    if frames.dtype != np.uint8 or frames.shape[2:] != (IMAGE_SIZE, IMAGE_SIZE):
        raise ValueError(
            f"{path} holds frames {frames.shape[2:]} {frames.dtype}; "
            f"the autoencoder takes ({IMAGE_SIZE}, {IMAGE_SIZE}) uint8"
        )
    expected = (frames.shape[0], frames.shape[1] - 1)
    if controls.shape[:2] != expected:
        raise ValueError(f"{path} holds controls {controls.shape}; expected {expected} + (p,)")
    if not np.isfinite(controls[:]).all():
        raise ValueError(f"{path} holds controls that are not finite")
