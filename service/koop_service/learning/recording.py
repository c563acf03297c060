"""Reading koop recordings (HDF5), with clear errors for files that do not fit."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401  (registers the Zstandard filter)
import numpy as np
import torch

from koop_protocol import recording as names
from koop_service.encoding.autoencoder import IMAGE_SIZE
from koop_service.encoding.weights import UNIT

_MARGIN = 10  # beyond it frames come in another unit
_MAKE = "make one with koop-dataset or koop-record"


@dataclass(frozen=True, eq=False)
class Recording:
    """N trajectories of T frames in memory.

    `frames` (N, T, 64, 64) uint8, or (N, T, C, H, W) float16 or float32 in `value_range`;
    `controls` (N, T-1, p), control k acting between frames k and k+1; `dt` the frame interval [s].
    """

    frames: np.ndarray
    controls: np.ndarray
    system: str
    renderer: str
    dt: float
    seed: int
    value_range: tuple[float, float] = UNIT

    @property
    def image_shape(self) -> tuple[int, ...]:
        """(H, W) or (C, H, W)."""
        return self.frames.shape[2:]

    def split(self, held_out: float) -> tuple[Recording, Recording]:
        """(seen, unseen): the last `held_out` share of the trajectories, one or more, is unseen."""
        count = len(self.frames)
        first = count - max(1, round(held_out * count))
        if first < 1:
            raise ValueError(
                f"the recording has {count} trajectory; training needs at least 2, or a preset "
                "that holds out sequences of long ones (flow)"
            )
        return self._part(slice(0, first)), self._part(slice(first, count))

    def split_in_time(self, held_out: float, length: int) -> tuple[Recording, Recording]:
        """(seen, unseen) of long trajectories: sequences of `length` frames, a `held_out` share.

        Each trajectory is cut into equal stretches, of which the last `length` frames are unseen:
        they share no frame with what is seen, and come from all of a schedule, not from its end.
        """
        total = self.frames.shape[1]
        stretch = total // max(1, int(held_out * total / length))
        if stretch < length + 2:
            raise ValueError(
                f"the recording has trajectories of {total} frames, of which {length} are held "
                f"out; training needs more than {length + 1}: record longer ones"
            )
        cut = self.cut(stretch)
        return cut._stretch(0, stretch - length), cut._stretch(stretch - length, stretch)

    def _part(self, which: slice) -> Recording:
        return replace(self, frames=self.frames[which], controls=self.controls[which])

    def cut(self, length: int) -> Recording:
        """Every trajectory as several of `length` frames; a rest is left out."""
        count = self.frames.shape[1] // length
        # The control between two pieces belongs to neither; a last one makes all pieces equal.
        controls = np.concatenate([self.controls, np.zeros_like(self.controls[:, :1])], axis=1)
        pieces = len(self.frames) * count  # told, since nothing can be counted where p is 0
        frames, controls = (
            values[:, : count * length].reshape(pieces, length, *values.shape[2:])
            for values in (self.frames, controls)
        )
        return replace(self, frames=frames, controls=controls[:, :-1])

    def _stretch(self, first: int, end: int) -> Recording:
        """Frames from `first` to before `end` of every trajectory."""
        frames, controls = self.frames[:, first:end], self.controls[:, first : end - 1]
        return replace(self, frames=frames, controls=controls)


def load_recording(path: Path) -> Recording:
    """Read `path` whole. Raises ValueError saying what is wrong with it."""
    with _open(path) as file:
        frames, controls = _check_shapes(path, file)
        _check_memory(path, frames, controls)
        values = _read(path, frames)
        recording = Recording(
            frames=values,
            controls=_read(path, controls).astype(np.float64),
            system=_text(path, file, names.SYSTEM_ATTRIBUTE),
            renderer=_text(path, file, names.RENDERER_ATTRIBUTE),
            dt=_number(path, file, names.DT_ATTRIBUTE),
            seed=_whole(path, file, names.SEED_ATTRIBUTE),
            value_range=_value_range(path, values),
        )
    if not math.isfinite(recording.dt) or recording.dt <= 0:
        raise ValueError(
            f"{path} has dt = {recording.dt} s between frames; expected a positive time"
        )
    if not np.isfinite(recording.controls).all():
        raise ValueError(f"{path} holds controls that are not finite; record it again without them")
    return recording


def load_manifest(path: Path) -> list[dict[str, Any]]:
    """How each trajectory came about: regime and physical parameters, or source and epoch.

    Raises ValueError where the file does not say so for each trajectory.
    """
    with _open(path) as file:
        frames = _dataset(path, file, names.FRAMES_DATASET)
        count = frames.shape[0] if frames.ndim else 0
        manifest = _dataset(path, file, names.PARAMETERS_DATASET)
        _check_memory(path, manifest)
        lines = _read(path, manifest)
    if lines.shape != (count,):
        raise ValueError(f"{path} has a manifest {lines.shape} for {count} trajectories; {_MAKE}")
    return [_entry(path, i, line) for i, line in enumerate(lines)]


def _entry(path: Path, i: int, line: Any) -> dict[str, Any]:
    try:
        entry = json.loads(line)
    except (TypeError, ValueError):
        entry = None
    if not isinstance(entry, dict):
        raise ValueError(f"{path} has a manifest whose line {i} is no JSON object; {_MAKE}")
    return entry


def _open(path: Path) -> h5py.File:
    """The file, once format and version are right."""
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(
            f"{path} cannot be read as HDF5; is the copy complete, and the path right? ({error})"
        ) from error
    try:
        _check_format(path, file)
    except ValueError:
        file.close()
        raise
    return file


def _check_format(path: Path, file: h5py.File) -> None:
    if str(_stored(path, file, names.FORMAT_ATTRIBUTE)) != names.RECORDING_FORMAT:
        raise ValueError(f"{path} is not a koop recording; {_MAKE}")
    version = _stored(path, file, names.VERSION_ATTRIBUTE)
    if str(version) != str(names.RECORDING_VERSION):
        raise ValueError(
            f"{path} is a recording of version {version}; this koop reads {names.RECORDING_VERSION}"
        )


def _check_shapes(path: Path, file: h5py.File) -> tuple[h5py.Dataset, h5py.Dataset]:
    frames = _dataset(path, file, names.FRAMES_DATASET)
    controls = _dataset(path, file, names.CONTROLS_DATASET)
    pictures = frames.dtype == np.uint8 and frames.shape[2:] == (IMAGE_SIZE, IMAGE_SIZE)
    fields = frames.dtype in (np.float16, np.float32) and frames.ndim == 5 and frames.size
    if not (pictures or fields):
        raise ValueError(
            f"{path} holds frames {frames.shape} {frames.dtype}; the autoencoder takes "
            f"({IMAGE_SIZE}, {IMAGE_SIZE}) uint8, or (C, H, W) float16 or float32, "
            "N trajectories of T each"
        )
    count, length = frames.shape[:2]
    if count < 1 or length < 2:
        raise ValueError(
            f"{path} holds {count} trajectories of {length} frames; "
            "expected at least one trajectory of at least 2 frames"
        )
    if controls.ndim != 3 or controls.shape[:2] != (count, length - 1):
        raise ValueError(
            f"{path} holds controls {controls.shape}; expected {(count, length - 1)} + (p,)"
        )
    if controls.dtype.kind not in "fiu":
        raise ValueError(f"{path} holds controls of type {controls.dtype}; expected float64")
    return frames, controls


def _value_range(path: Path, frames: np.ndarray) -> tuple[float, float]:
    """Where values may lie: UNIT for pictures, else ten times the largest in size either way."""
    if frames.dtype == np.uint8:
        return UNIT
    # By torch, whose float16 is a hundred times as fast as numpy's; frame by frame, for the cache.
    ends = [torch.aminmax(torch.from_numpy(f)) for trajectory in frames for f in trajectory]
    largest = float(torch.tensor(ends).abs().amax())
    if not math.isfinite(largest):
        raise ValueError(f"{path} holds frames that are not finite; record it again without them")
    return -_MARGIN * largest, _MARGIN * largest


def _check_memory(path: Path, *datasets: h5py.Dataset) -> None:
    # A few kilobytes of HDF5 can declare any size; and training holds the set as it is.
    needed = sum(dataset.size * dataset.dtype.itemsize for dataset in datasets)
    free = free_memory()
    if needed > free:
        raise ValueError(
            f"{path} needs {_gigabytes(needed)} of memory and {_gigabytes(free)} are free; "
            "use fewer trajectories, or a larger machine"
        )


def free_memory() -> int:
    """Memory that can be had without swapping [bytes]: Linux's own estimate, else free pages."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if "MemAvailable" in line)
    except (OSError, StopIteration):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _gigabytes(size: int) -> str:
    return f"{size / 2**30:.3g} GiB"


def _read(path: Path, dataset: h5py.Dataset) -> np.ndarray:
    with _read_from(path, str(dataset.name)):
        return np.asarray(dataset[()])


def _dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    with _read_from(path, name):
        dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
        raise ValueError(f"{path} has no data set {name!r}; {_MAKE}")
    return dataset


def _attribute(path: Path, file: h5py.File, name: str) -> Any:
    value = _stored(path, file, name)
    if value is None:
        raise ValueError(f"{path} has no attribute {name!r}; {_MAKE}")
    return value


def _stored(path: Path, file: h5py.File, name: str) -> Any:
    """An attribute as it stands, or None."""
    with _read_from(path, f"attribute {name!r}"):
        return file.attrs.get(name)


@contextmanager
def _read_from(path: Path, part: str) -> Iterator[None]:
    """ValueError for whatever h5py raises where a file is damaged in this part."""
    try:
        yield
    except (OSError, KeyError, TypeError, RuntimeError, ValueError) as error:
        raise ValueError(f"{path} is damaged in its {part}: {error}") from error


def _text(path: Path, file: h5py.File, name: str) -> str:
    value = _attribute(path, file, name)
    if not isinstance(value, str):
        raise ValueError(f"{path} has {name} = {value!r}; expected text")
    return value


def _number(path: Path, file: h5py.File, name: str) -> float:
    value = np.asarray(_attribute(path, file, name))
    if value.ndim or value.dtype.kind not in "fiu":
        raise ValueError(f"{path} has {name} = {value!r}; expected a number")
    return float(value)


def _whole(path: Path, file: h5py.File, name: str) -> int:
    value = _number(path, file, name)
    if not value.is_integer():
        raise ValueError(f"{path} has {name} = {value}; expected a whole number")
    return int(value)
