"""A setting of the whole process: how much memory it keeps between two messages."""

from __future__ import annotations

import ctypes
import sys

_M_ARENA_MAX = -8
_ARENAS = 1


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
