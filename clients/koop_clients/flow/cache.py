"""States kept between runs in the user's cache folder: whole or not at all, whoever starts when."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np


def cache_folder() -> Path:
    """`koop/flow` in the user's cache folder, as the XDG base directory specification has it."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base.startswith("/") else Path.home() / ".cache") / "koop" / "flow"


def kept(
    folder: Path,
    name: str,
    settings: Mapping[str, Any],
    like: tuple[tuple[int, ...], Any],
    make: Callable[[], np.ndarray],
) -> np.ndarray:
    """The array that `make` makes of `settings`, made only where `folder` has no sound copy.

    Of several starters one makes it while the others wait. A folder that cannot be written costs a
    warning, and the time to make it again.

    Args:
        folder: where it is kept.
        name: how its file begins; a hash of `settings` follows.
        settings: all that the array depends on, as JSON has it.
        like: its shape and type.
        make: makes it.
    """
    path = folder / f"{name}-{_digest(settings)}.npz"
    found = _load(path, like)
    if found is not None:
        return found
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(path):
            return _load_or_make(path, like, make)
    except OSError as error:
        warnings.warn(_unkept(folder, error), stacklevel=2)
        return make()


def _load_or_make(
    path: Path, like: tuple[tuple[int, ...], Any], make: Callable[[], np.ndarray]
) -> np.ndarray:
    found = _load(path, like)  # another starter may have been faster
    if found is not None:
        return found
    array = make()
    try:
        _store(path, array)
    except OSError as error:
        warnings.warn(_unkept(path.parent, error), stacklevel=3)
    return array


def _digest(settings: Mapping[str, Any]) -> str:
    text = json.dumps(dict(settings), sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _load(path: Path, like: tuple[tuple[int, ...], Any]) -> np.ndarray | None:
    """None where there is no file, or one that is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.testzip() is not None:  # before a damaged header asks for any memory
                return None
        with np.load(path, allow_pickle=False) as file:
            array = file["state"]
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile):
        return None
    shape, dtype = like
    return array if array.shape == shape and array.dtype == dtype else None


def _store(path: Path, array: np.ndarray) -> None:
    """A file that only takes its name once it is whole and on the disk."""
    for left_over in path.parent.glob(f"{path.name}.*.partial"):  # of a killed process
        left_over.unlink(missing_ok=True)
    handle, partial = tempfile.mkstemp(".partial", f"{path.name}.", path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, state=array)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        with suppress(FileNotFoundError):
            os.unlink(partial)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """The kernel drops the lock with its process, however that ends."""
    with path.with_suffix(".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _unkept(folder: Path, error: OSError) -> str:
    return (
        f"cannot keep the flow in {folder} ({error.strerror or error}), so the next run will "
        "compute it again; set XDG_CACHE_HOME to a folder that can be written"
    )
