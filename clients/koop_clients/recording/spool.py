"""Segments on disk while a recording goes on: each a small recording, whole or not there.

HDF5 refuses a file whose writer was killed. So each segment is written under a temporary name and
renamed once it is complete, and all are joined at the end: a kill -9 costs only what is not yet a
whole segment.
"""

from __future__ import annotations

import fcntl
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import h5py
import hdf5plugin  # noqa: F401  (registers the Zstandard filter)
import numpy as np

from koop_clients.recording.assembly import Segment
from koop_clients.recording.file import Header, Row, write_recording
from koop_protocol import recording as names


@dataclass(frozen=True)
class Joined:
    """What a spool became: `count` segments of `length` frames under one header.

    `spread` is the largest share by which a segment's own dt differs from the file's.
    """

    count: int
    length: int
    header: Header
    spread: float


class Spool:
    """The folder beside `out` that holds the segments until they are joined into it.

    Raises ValueError where `out` exists, or where another process uses the folder.
    """

    def __init__(self, out: Path) -> None:
        if out.exists():
            raise ValueError(f"{out} exists already; choose another --out, or remove it")
        self.out = out
        self.folder = out.with_name(out.name + ".segments")
        self.count = 0
        self._held: TextIO | None = None

    @property
    def files(self) -> list[Path]:
        """The whole segments, in the order of their recording."""
        return sorted(self.folder.glob("*.h5"))

    def begin(self) -> None:
        """Make the folder. Raises ValueError where a recording did not end."""
        if self.files:
            raise ValueError(
                f"{self.folder} holds {len(self.files)} segments of a recording that did not end; "
                f"join them with `koop-record --recover --out {self.out}`, or remove the folder"
            )
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock()

    def resume(self) -> None:
        """Take over what a killed recording left. Raises ValueError where it left nothing."""
        if not self.files:
            raise ValueError(f"there is no segment to recover in {self.folder}")
        self._lock()

    def add(self, segment: Segment, renderer: str) -> None:
        """Write one segment; from now on it survives a kill of this process."""
        length, p = len(segment.frames), segment.controls.shape[1]
        dt = float(np.median(np.diff(segment.times)))
        header = Header(segment.trajectory, renderer, dt, control_size=p)
        source = {"trajectory": segment.trajectory, "epoch": segment.epoch, "seq": segment.seq}
        row = Row(segment.frames, segment.controls, np.zeros((length, 0)), {**source, "dt": dt})
        write_recording(self.folder / f"{self.count:08d}.h5", header, 1, length, [row])
        self.count += 1

    def join(self, system: str | None = None, dt: float | None = None) -> Joined:
        """Write all segments into `out`, and remove the folder.

        `system` is by default the first chunk of the first trajectory's name, `dt` [s] the median
        time between the arrivals of two frames.
        """
        files = self.files
        first, length = _header(files[0])
        spacing = np.array([_header(path)[0].dt for path in files])
        if dt is None:
            dt = float(f"{np.median(spacing):.3g}")  # arrivals are good to about three digits
        if dt <= 0:
            raise ValueError("the frames came all at once, which tells nothing of dt; give --dt")
        header = Header(
            system or first.system.split("/")[0], first.renderer, dt, first.control_size
        )
        write_recording(self.out, header, len(files), length, map(_row, files))
        self.remove()
        self.close()
        return Joined(len(files), length, header, float(np.abs(spacing / dt - 1).max()))

    def remove(self) -> None:
        """Remove the folder and what is in it."""
        for path in self.folder.iterdir():
            path.unlink()
        self.folder.rmdir()

    def close(self) -> None:
        """Leave the folder to others."""
        if self._held is not None:
            self._held.close()
            self._held = None

    def _lock(self) -> None:
        # Gone with the process, however that ends.
        self._held = (self.folder / "lock").open("w")
        try:
            fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"another koop-record is writing {self.out}; stop that first"
            ) from error


def _header(path: Path) -> tuple[Header, int]:
    """Header of one segment, its `system` being the whole trajectory's name, and its length."""
    with h5py.File(path) as file:
        known: dict[str, Any] = dict(file.attrs)
        _, steps, p = _dataset(file, names.CONTROLS_DATASET).shape
    system, renderer = known[names.SYSTEM_ATTRIBUTE], known[names.RENDERER_ATTRIBUTE]
    return Header(system, renderer, float(known[names.DT_ATTRIBUTE]), p), steps + 1


def _row(path: Path) -> Row:
    with h5py.File(path) as file:
        return Row(
            _dataset(file, names.FRAMES_DATASET)[0],
            _dataset(file, names.CONTROLS_DATASET)[0],
            _dataset(file, names.STATES_DATASET)[0],
            json.loads(_dataset(file, names.PARAMETERS_DATASET)[0]),
        )


def _dataset(file: h5py.File, name: str) -> Any:
    return file[name]
