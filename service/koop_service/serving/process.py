"""A setting of the whole process: how much memory it keeps between two messages."""

from __future__ import annotations

import ctypes
import sys

_M_ARENA_MAX = -8
_ARENAS = 1


def limit_arenas() -> None:
    """Have glibc's malloc use two arenas.

    It would keep one for each of Zenoh's threads, and the service would grow for hours.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(_M_ARENA_MAX, _ARENAS)
