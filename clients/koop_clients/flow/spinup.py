"""Where a simulation begins: a wake that has developed, or the steady flow that hides under it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from koop_clients.flow.cache import cache_folder, kept
from koop_clients.flow.cylinder import CylinderFlow

# Frames done, and of how many.
Progress = Callable[[int, int], None]

_SOLVER = 1  # of the cache's entries: raise it where the same settings give another flow

_SHAKING, _RATE = 60.0, 0.13  # D/U, U/D: near the wake's own frequency, it grows faster so
_SHAKE = 1.0  # U/D
_SETTLING = 150.0  # D/U without it

_AVERAGING = 200.0  # D/U


def developed(
    flow: CylinderFlow, progress: Progress | None = None, folder: Path | None = None
) -> np.ndarray:
    """A state in the natural wake's limit cycle, of the cylinder at rest.

    The first call for a flow's settings takes its time and tells `progress`; later ones read the
    cache, by default the user's.
    """
    return _kept("developed", _develop, flow, progress, folder)


def steady(
    flow: CylinderFlow, progress: Progress | None = None, folder: Path | None = None
) -> np.ndarray:
    """The steady flow, a symmetric state that no small disturbance leaves in peace. Cached too."""
    return _kept("steady", _average, flow, progress, folder)


def _kept(
    name: str,
    make: Callable[[CylinderFlow, Progress], np.ndarray],
    flow: CylinderFlow,
    progress: Progress | None,
    folder: Path | None,
) -> np.ndarray:
    dtype = np.dtype(flow.lattice.dtype)
    settings = {"solver": _SOLVER, "dtype": dtype.name, **flow.settings.as_dict()}
    like = (flow.lattice.shape, dtype)
    tell = progress or (lambda _done, _total: None)
    return kept(folder or cache_folder(), name, settings, like, lambda: make(flow, tell))


def _develop(flow: CylinderFlow, progress: Progress) -> np.ndarray:
    """Shake the cylinder until the wake is awake, then leave it alone."""
    interval = flow.settings.frame_time
    shaken, total = _frames(_SHAKING, interval), _frames(_SHAKING + _SETTLING, interval)
    state = flow.at_rest()
    for number in range(total):
        rotation = _SHAKE * math.sin(2 * math.pi * _RATE * number * interval)
        state = flow.frame(state, rotation if number < shaken else 0.0)
        progress(number + 1, total)
    return state


def _average(flow: CylinderFlow, progress: Progress) -> np.ndarray:
    """Averaging with the mirror image at each frame lets nothing grow that is not symmetric."""
    total = _frames(_AVERAGING, flow.settings.frame_time)
    state = flow.at_rest()
    for number in range(total):
        state = flow.frame(state)
        state = (state + flow.mirrored(state)) / 2
        progress(number + 1, total)
    return state


def _frames(time: float, interval: float) -> int:
    return math.ceil(time / interval)
