"""Reading koop recordings (HDF5), with clear errors for files that do not fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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

    def split(self, held_out: float) -> tuple[Recording, Recording]:
        """(seen, unseen): the last `held_out` share of the trajectories, one or more, is unseen."""
        count = len(self.frames)
        first = count - max(1, round(held_out * count))
        if first < 1:
            raise ValueError(f"the recording has {count} trajectory; training needs at least 2")
        return self._part(slice(0, first)), self._part(slice(first, count))

    def _part(self, which: slice) -> Recording:
        return replace(self, frames=self.frames[which], controls=self.controls[which])


def load_recording(path: Path) -> Recording:
    """Read `path` whole. Raises ValueError saying what is wrong with it."""
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path} cannot be read as HDF5: {error}") from error
    with file:
        _check(path, file)
        attributes: dict[str, Any] = dict(file.attrs)
        return Recording(
            frames=_dataset(path, file, names.FRAMES_DATASET)[:],
            controls=_dataset(path, file, names.CONTROLS_DATASET)[:],
            system=str(attributes[names.SYSTEM_ATTRIBUTE]),
            renderer=str(attributes[names.RENDERER_ATTRIBUTE]),
            dt=float(attributes[names.DT_ATTRIBUTE]),
            seed=int(attributes[names.SEED_ATTRIBUTE]),
        )


def _check(path: Path, file: h5py.File) -> None:
    if file.attrs.get(names.FORMAT_ATTRIBUTE) != names.RECORDING_FORMAT:
        raise ValueError(f"{path} is not a koop recording; make one with koop-dataset")
    version: Any = file.attrs.get(names.VERSION_ATTRIBUTE)
    if version != names.RECORDING_VERSION:
        raise ValueError(
            f"{path} is a recording of version {version}; this koop reads {names.RECORDING_VERSION}"
        )
    frames = _dataset(path, file, names.FRAMES_DATASET)
    controls = _dataset(path, file, names.CONTROLS_DATASET)
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


def _dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"{path} has no data set {name!r}; make the recording with koop-dataset")
    return dataset
