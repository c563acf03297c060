"""The cylinder's recordings: a few long trajectories, written frame by frame as they are computed.

The file is a koop recording with frames (N, T, 4, H, W) of float16, normalised; see `CHANNELS`,
`MEAN` and `SCALE` of the renderer, which are attributes of the file too. Its states (N, T, 1) are
the transverse velocity behind the cylinder [U].
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
import hdf5plugin
import numpy as np

from koop_clients.flow.cylinder import CHANNELS, MEAN, RENDERER, SCALE, CylinderFlow
from koop_clients.flow.forcing import Regime, law
from koop_clients.flow.plant import FlowPlant, starting
from koop_clients.flow.settings import FRAME_INTERVAL, WINDOW, FlowSettings
from koop_clients.flow.spinup import Progress, steady
from koop_clients.recording.file import Header, describe, new_recording
from koop_protocol import recording as names

# The paper's lengths (A.3) [frames]; one frame of the steady flow is as good as many.
FRAMES = {"rest": 4328, "schedule": 5000, "feedback": 5000, "mix": 5000, "steady": 1}


@dataclass(frozen=True)
class FlowRecipe:
    """What a recording of the cylinder is made of.

    Attributes:
        settings: of the flow.
        regime: how the cylinder turns, or `steady`: the steady flow, all frames alike.
        trajectories: how many, each from a phase and with a schedule of its own.
        frames: of each; 0 takes the paper's length.
        seed: of phases and schedules.
    """

    settings: FlowSettings
    regime: Regime | Literal["steady"] = "rest"
    trajectories: int = 1
    frames: int = 0
    seed: int = 0

    @property
    def length(self) -> int:
        """Frames of each trajectory."""
        return self.frames or FRAMES[self.regime]

    @property
    def is_actuated(self) -> bool:
        """Whether the cylinder may turn."""
        return self.regime not in ("rest", "steady")


@dataclass(frozen=True, eq=False)
class Moment:
    """A frame (4, H, W) float16, the probe's velocity [U], and the rotation that follows [U/D]."""

    picture: np.ndarray
    probe: float
    rotation: float


def write_flow(
    path: Path,
    recipe: FlowRecipe,
    spun_up: Progress | None = None,
    wrote: Callable[[], object] = lambda: None,
) -> None:
    """Simulate and write; `path` is replaced only once the file is complete.

    `spun_up` hears how the flow develops, if it must; `wrote` is called after each frame.
    """
    flow = CylinderFlow(recipe.settings)
    with new_recording(path) as file:
        frames, controls, states = _data_sets(file, recipe, flow)
        for i in range(recipe.trajectories):
            for k, moment in enumerate(_moments(flow, recipe, i, spun_up)):
                frames[i, k], states[i, k] = moment.picture, moment.probe
                if recipe.is_actuated and k + 1 < recipe.length:
                    controls[i, k] = moment.rotation
                wrote()
        describe(file, _header(recipe), [_entry(recipe)] * recipe.trajectories)
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


def _moments(
    flow: CylinderFlow, recipe: FlowRecipe, index: int, spun_up: Progress | None
) -> Iterator[Moment]:
    if recipe.regime == "steady":
        state = steady(flow, spun_up)
        yield from [Moment(flow.picture(state), flow.probe(state), 0.0)] * recipe.length
        return
    seed = (recipe.seed, index)
    plant = FlowPlant(flow, law(recipe.regime, seed), starting(flow, seed, spun_up))
    for _ in range(recipe.length):
        picture, probe = plant.draw(), plant.probe
        yield Moment(picture, probe, plant.advance())


def _header(recipe: FlowRecipe) -> Header:
    return Header(
        "cylinder", RENDERER, FRAME_INTERVAL, int(recipe.is_actuated), state_size=1,
        seed=recipe.seed,
    )  # fmt: skip


def _entry(recipe: FlowRecipe) -> dict[str, Any]:
    settings = recipe.settings
    return {"regime": recipe.regime, "frame_time": settings.frame_time, **settings.as_dict()}
