"""Writing the HDF5 file of a recording, for simulated sets and live streams alike."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from koop_protocol import recording as names

IMAGE_SIZE = 64  # pixels


@dataclass(frozen=True)
class Header:
    """What holds for the whole file.

    `control_size` is p, `state_size` nx (0 where nobody knows the state), `dt` the time between
    frames [s], `renderer` "" for a camera.
    """

    system: str
    renderer: str
    dt: float
    control_size: int
    state_size: int = 0
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Row:
    """One trajectory: `frames` (T, 64, 64) uint8, `controls` (T-1, p), `states` (T, nx).

    `entry` is its line of the manifest: how it came about.
    """

    frames: np.ndarray
    controls: np.ndarray
    states: np.ndarray
    entry: Mapping[str, Any]


def write_recording(
    path: Path, header: Header, count: int, length: int, rows: Iterable[Row]
) -> None:
    """Write `count` rows of `length` frames; `path` is replaced only once the file is complete."""
    with new_recording(path) as file:
        _fill(file, header, count, length, rows)


@contextmanager
def new_recording(path: Path) -> Iterator[h5py.File]:
    """A file that takes its place at `path` only if the block that fills it comes to its end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    try:
        with h5py.File(partial, "w") as file:
            yield file
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def describe(file: h5py.File, header: Header, manifest: Sequence[Mapping[str, Any]]) -> None:
    """Add the attributes, and the manifest with its entry for each trajectory."""
    # An attribute holds at most 64 KB: the manifest, a line a trajectory, is a data set.
    lines = [json.dumps(dict(entry)) for entry in manifest]
    file.create_dataset(names.PARAMETERS_DATASET, data=lines, dtype=h5py.string_dtype())
    file.attrs.update(_attributes(header))


def _fill(file: h5py.File, header: Header, count: int, length: int, rows: Iterable[Row]) -> None:
    shape = (length, IMAGE_SIZE, IMAGE_SIZE)
    frames = file.create_dataset(
        names.FRAMES_DATASET, (count, *shape), np.uint8, chunks=(1, *shape), **hdf5plugin.Zstd(3)
    )
    sizes = (count, length - 1, header.control_size), (count, length, header.state_size)
    controls = file.create_dataset(names.CONTROLS_DATASET, sizes[0], np.float64)
    states = file.create_dataset(names.STATES_DATASET, sizes[1], np.float64)
    manifest = []
    # Strict: a row too few would leave black frames behind.
    for i, row in zip(range(count), rows, strict=True):
        frames[i], controls[i], states[i] = row.frames, row.controls, row.states
        manifest.append(row.entry)
    describe(file, header, manifest)


def _attributes(header: Header) -> dict[str, Any]:
    return {
        names.FORMAT_ATTRIBUTE: names.RECORDING_FORMAT,
        names.VERSION_ATTRIBUTE: names.RECORDING_VERSION,
        names.SYSTEM_ATTRIBUTE: header.system,
        names.ACTUATED_ATTRIBUTE: header.control_size > 0,
        names.RENDERER_ATTRIBUTE: header.renderer,
        names.DT_ATTRIBUTE: header.dt,
        names.SEED_ATTRIBUTE: header.seed,
    }
