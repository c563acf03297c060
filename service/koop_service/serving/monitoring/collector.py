"""Python's collector of cycles, kept from going through all trajectories while everybody waits.

A full collection looks at every object that has lived long: 10 ms with a thousand trajectories, 100
with ten thousand. These hold no cycles, so who leaves memory is freed without it. What has outlived
one full collection is therefore left out of the next ones, up to one in many that looks at all.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_WHOLE = 256
"""One in so many full collections looks at everything: no cycle that is left out stays for ever."""


def settle() -> None:
    """What is there now lives long."""
    gc.collect()
    gc.freeze()


@contextmanager
def sparing() -> Iterator[None]:
    """From now on, until the context ends, what outlives a full collection lives long."""
    settle()
    collections = 0

    def attend(phase: str, about: dict[str, Any]) -> None:
        nonlocal collections
        if about["generation"] < 2:
            return
        if phase == "stop":
            collections += 1
            gc.freeze()
        elif (collections + 1) % _WHOLE == 0:
            gc.unfreeze()

    gc.callbacks.append(attend)
    try:
        yield
    finally:
        gc.callbacks.remove(attend)
        gc.unfreeze()
