"""The cylinder's recordings: a few long trajectories, written frame by frame as they are computed.

The file is a koop recording with frames (N, T, 4, H, W) of float16, normalised; see `CHANNELS`,
`MEAN` and `SCALE` of the renderer, which are attributes of the file too. Its states (N, T, 1) are
the transverse velocity behind the cylinder [U].
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from koop_clients.dataset.moments import FlowRecipe, moments
from koop_clients.flow.cylinder import CHANNELS, MEAN, RENDERER, SCALE, CylinderFlow
from koop_clients.flow.settings import FRAME_INTERVAL, WINDOW
from koop_clients.flow.spinup import Progress
from koop_clients.recording.file import Header, describe, new_recording
from koop_protocol import recording as names


def write_flow(
    path: Path,
    recipe: FlowRecipe,
    spun_up: Progress | None = None,
    wrote: Callable[[], object] = lambda: None,
    workers: int = 1,
) -> None:
    """Simulate and write; `path` is replaced only once the file is complete.

    `spun_up` hears how the flow develops, if it must; `wrote` is called after each frame. Several
    `workers` share the trajectories, and write the same file.
    """
    flow = CylinderFlow(recipe.settings)
    with new_recording(path) as file:
        frames, controls, states = _data_sets(file, recipe, flow)
        for i, k, moment in moments(recipe, workers, spun_up):
            frames[i, k], states[i, k] = moment.picture, moment.probe
            if recipe.is_actuated and k + 1 < recipe.length:
                controls[i, k] = moment.rotation
            wrote()
        describe(file, _header(recipe), [_entry(recipe, i) for i in range(recipe.trajectories)])
        file.attrs[names.CHANNELS_ATTRIBUTE] = list(CHANNELS)
        file.attrs[names.CHANNEL_MEAN_ATTRIBUTE] = MEAN
        file.attrs[names.CHANNEL_SCALE_ATTRIBUTE] = SCALE
        file.attrs[names.WINDOW_ATTRIBUTE] = WINDOW


def _data_sets(file: h5py.File, recipe: FlowRecipe, flow: CylinderFlow) -> tuple[Any, Any, Any]:
    count, length = recipe.trajectories, recipe.length
    shape = flow.channels(flow.at_rest()).shape
    frames = file.create_dataset(
        names.FRAMES_DATASET,
        (count, length, *shape),
        np.float16,
        chunks=(1, 1, *shape),  # a sequence may begin anywhere in 5,000 frames
        shuffle=True,
        **hdf5plugin.Zstd(3),
    )
    sizes = (count, length - 1, int(recipe.is_actuated)), (count, length, 1)
    controls = file.create_dataset(names.CONTROLS_DATASET, sizes[0], np.float64)
    states = file.create_dataset(names.STATES_DATASET, sizes[1], np.float64)
    return frames, controls, states


def _header(recipe: FlowRecipe) -> Header:
    return Header(
        "cylinder", RENDERER, FRAME_INTERVAL, int(recipe.is_actuated), state_size=1,
        seed=recipe.seed,
    )  # fmt: skip


def _entry(recipe: FlowRecipe, index: int) -> dict[str, Any]:
    settings = recipe.settings
    return {"regime": recipe.regime(index), "frame_time": settings.frame_time, **settings.as_dict()}
