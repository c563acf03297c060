"""Files of a deployment: keys that only their owner can read, and nothing overwritten by chance."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from koop_clients.pki.certificates import Identity, read_identity

CERTIFICATE, KEY, CA, CONFIGURATION = "cert.pem", "key.pem", "ca.pem", "zenoh.json5"


def make_folder(folder: Path) -> None:
    """Make a folder that only its owner can enter. FileExistsError where there is one."""
    try:
        folder.mkdir(mode=0o700, parents=True)
    except FileExistsError:
        raise FileExistsError(
            f"{folder} exists already, and nothing in it is overwritten; choose another name, or "
            "see `koop-pki renew` and `koop-pki remove`"
        ) from None


def write_identity(folder: Path, identity: Identity) -> None:
    """Write cert.pem and key.pem, which must not exist."""
    write_new(folder / KEY, identity.key_pem, 0o600)
    write_new(folder / CERTIFICATE, identity.certificate_pem)


def replace_identity(folder: Path, identity: Identity) -> None:
    """Write cert.pem and key.pem in the place of the former ones."""
    replace(folder / KEY, identity.key_pem, 0o600)
    replace(folder / CERTIFICATE, identity.certificate_pem)


def load_identity(folder: Path) -> Identity:
    """The identity in a folder. ValueError where there is none that can be read."""
    try:
        return read_identity((folder / CERTIFICATE).read_bytes(), (folder / KEY).read_bytes())
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{folder} holds no certificate with its key: {error}") from error


def write_new(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write a file that does not exist, with this mode from its first byte on."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(data)


def replace(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write a file in the place of another, whole or not at all."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    write_new(beside, data, mode)
    os.replace(beside, path)


def remove_folder(folder: Path, names: Iterable[str]) -> None:
    """Remove these files, and the folder unless it holds others."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()
