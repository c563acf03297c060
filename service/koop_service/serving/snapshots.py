"""The estimators on disk between two runs: one LMDB file, written whole at a clean exit.

A snapshot only saves time: without one a trajectory warms up again. So anything doubtful is left
out with a line in the log. LMDB maps its file into memory and trusts it; a digest beside it keeps
a damaged one from ever being opened.
"""

from __future__ import annotations

import hashlib
import logging
import os
from pathlib import Path
from typing import Any, cast

import lmdb
import msgpack
import numpy as np

log = logging.getLogger("koop.snapshots")

_FILE = "estimators.lmdb"
_SPARE = 16 << 20


class SnapshotStore:
    """Records by trajectory name in a state folder; a record holds plain values and arrays."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / _FILE
        self._digest = folder / (_FILE + ".blake2b")

    def prepare(self) -> None:
        """Make the folder. Raises OSError where it cannot be written."""
        folder = self._path.parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not os.access(folder, os.W_OK):
                raise PermissionError("it cannot be written")
        except OSError as error:
            raise OSError(
                f"the state folder {folder} cannot be used ({error}); choose another --state-folder"
            ) from error

    def load(self) -> dict[str, dict[str, Any]]:
        """All records; none where the file is missing, damaged or of another version."""
        if not self._path.exists():
            return {}
        try:
            if self._digest.read_text().strip() != _digest(self._path):
                raise ValueError("its digest does not fit")
            return {name: _unpack(data) for name, data in self._read().items()}
        except Exception as error:
            log.warning("the state in %s is left out: %s", self._path, error)
            return {}

    def save(self, records: dict[str, dict[str, Any]]) -> None:
        """Replace all records, in one transaction and one rename. Raises OSError."""
        partial = self._path.with_suffix(".partial")
        partial.unlink(missing_ok=True)
        try:
            self._write(partial, {name: _pack(record) for name, record in records.items()})
        except lmdb.Error as error:
            raise OSError(f"the state cannot be stored in {partial}: {error}") from error
        digest = partial.with_suffix(".digest")
        digest.write_text(_digest(partial) + "\n")
        os.replace(partial, self._path)
        os.replace(digest, self._digest)

    def _read(self) -> dict[str, bytes]:
        with (
            lmdb.open(str(self._path), subdir=False, readonly=True, lock=False) as environment,
            environment.begin() as transaction,
        ):
            return {bytes(name).decode(): bytes(data) for name, data in transaction.cursor()}

    def _write(self, path: Path, records: dict[str, bytes]) -> None:
        size = 2 * sum(len(name) + len(data) + 512 for name, data in records.items()) + _SPARE
        with (
            lmdb.open(str(path), subdir=False, map_size=size, lock=False) as environment,
            environment.begin(write=True) as transaction,
        ):
            for name, data in records.items():
                transaction.put(name.encode(), data)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()


def _pack(record: dict[str, Any]) -> bytes:
    return cast(bytes, msgpack.packb(record, default=_array_to_map))


def _unpack(data: bytes) -> dict[str, Any]:
    return msgpack.unpackb(data, object_hook=_array_from_map, strict_map_key=False)


def _array_to_map(value: object) -> object:
    if isinstance(value, np.ndarray):
        return {"": value.dtype.str, "shape": value.shape, "data": value.tobytes()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _array_from_map(value: dict[Any, Any]) -> object:
    if "" not in value:
        return value
    return np.frombuffer(value["data"], np.dtype(value[""])).reshape(value["shape"]).copy()
