"""Is an LMDB file sound? Asked in a process of its own, since a damaged one may kill who asks.

LMDB maps its file into memory and trusts every page of it. So before the service opens a file, a
child reads all of it: the trees by the copy that compacts them (thrown away), the records by their
digests.

    python -m koop_service.serving.durability.inspection FILE FORMAT
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import lmdb

from koop_service.serving.trajectories.sealing import is_whole

FORMAT_KEY = b"format"
RECORDS, OWNERS, TIMES = b"records", b"owners", b"times"
_PATIENCE = 120.0
"""Longest time that it may take [s]; a gigabyte takes about two."""


def why_unfit(path: Path, format_: bytes) -> str:
    """Why the service must not open this file; "" where it may."""
    command = [sys.executable, "-m", __name__, str(path), format_.decode()]
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}  # this very koop, not another
    try:
        child = subprocess.run(
            command, env=places, capture_output=True, text=True, timeout=_PATIENCE, check=False
        )
    except subprocess.TimeoutExpired:
        return f"reading it takes longer than {_PATIENCE:g} s"
    if child.returncode == 0:
        return ""
    if child.returncode < 0:
        return f"it is damaged: reading it ended with signal {-child.returncode}"
    return (child.stderr.strip().splitlines() or ["it cannot be read"])[-1]


def inspect(path: Path, format_: bytes) -> None:
    """Read all of the file. Raises ValueError or lmdb.Error, or takes the process down with it."""
    with lmdb.open(str(path), subdir=False, readonly=True, max_dbs=2) as environment:
        with environment.begin() as transaction:
            if transaction.get(FORMAT_KEY) != format_:
                raise ValueError("it is not of this version")
        sink = os.open(os.devnull, os.O_WRONLY)
        try:
            environment.copyfd(sink, compact=True)
        finally:
            os.close(sink)
        records = environment.open_db(RECORDS, create=False)
        with environment.begin(db=records) as transaction:
            for name, sealed in transaction.cursor():
                if not is_whole(sealed):
                    raise ValueError(f"it is damaged: so is the record {name!r}")


if __name__ == "__main__":
    try:
        inspect(Path(sys.argv[1]), sys.argv[2].encode())
    except (ValueError, lmdb.Error, OSError) as error:
        sys.exit(str(error))
