"""The memory of the whole process: how much it has, and keeps between two messages."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

_M_ARENA_MAX = -8
_ARENAS = 1
_STATM = Path("/proc/self/statm")


def limit_arenas() -> None:
    """Have glibc's malloc use a single arena.

    It would keep one for each of Zenoh's threads, and place the encoder's large buffers where they
    fragment: tens of megabytes more, and growth for hours. The pipeline is the one thread that
    allocates much, so that nobody waits for the arena's lock.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(_M_ARENA_MAX, _ARENAS)


def tells_memory() -> bool:
    """Whether this system says how much memory the process has."""
    return _STATM.exists()


def own_bytes() -> int:
    """The process's memory that only swapping could free: without pages of files, such as LMDB's,
    which the system drops when it needs them."""
    _, resident, of_files, *_ = map(int, _STATM.read_text().split())
    return (resident - of_files) * os.sysconf("SC_PAGE_SIZE")
