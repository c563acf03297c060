"""Command line of `koop-dataset`."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from koop_clients.dataset.generate import Recipe, generate
from koop_clients.mechanics.excitation import Regime
from koop_clients.mechanics.rendering import IMAGE_SIZE, RENDERER
from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.mechanics.systems import build_system
from koop_protocol import recording

try:
    import h5py
    import hdf5plugin
    from tqdm import tqdm
except ModuleNotFoundError as error:
    sys.exit(f"koop-dataset needs {error.name}: pip install 'koop[train]'")

# Actuated sets mix regimes: probing and soft ones identify A and B in the region where control
# acts and around the hanging position, and free swings show what a plant does with its motor off.
_ACTUATED_MIX: dict[Regime, float] = {
    "probing": 0.25,
    "soft": 0.25,
    "soft-hanging": 0.3,
    "free": 0.2,
}


@dataclass(frozen=True)
class Arguments:
    """Simulate and draw a training set, and write it as one HDF5 file."""

    system: Literal["pendulum", "double-pendulum", "cartpole"]
    """Which plant."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The HDF5 file to write."""
    trajectories: int = 1000
    """How many trajectories."""
    frames: int = 0
    """Frames in each (50 ms apart); 0 takes the paper's 100, or 200 when actuated."""
    actuated: bool = False
    """Drive the pole's joint, as the paper's section 3.3 does."""
    excitation: Literal["mix", "paper", "probing", "soft"] = "mix"
    """How an actuated plant is driven: the paper's tight tracking, tracking with a probing torque,
    softly with more of it, or a mix of these and free swings."""
    vary: bool = False
    """Draw masses and lengths anew for each trajectory."""
    high: bool = False
    """Free plants start anywhere in [0, 2 pi], not only in [pi/2, 3 pi/2]."""
    seed: int = 0
    """Seed; the same seed gives the same file."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Processes."""


def main() -> None:
    """Entry point."""
    arguments = tyro.cli(Arguments, prog="koop-dataset")
    try:
        write(arguments)
    except (OSError, ValueError) as error:
        sys.exit(f"koop-dataset: {error}")


def write(arguments: Arguments) -> None:
    """Generate the set and write it to `arguments.out` (replaced only once it is complete)."""
    if arguments.trajectories < 1 or arguments.frames < 0:
        raise ValueError("--trajectories must be at least 1 and --frames not negative")
    recipe = _recipe(arguments)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    partial = arguments.out.with_name(arguments.out.name + ".partial")
    with h5py.File(partial, "w") as file:
        _fill(file, recipe, arguments)
    partial.replace(arguments.out)
    print(f"wrote {arguments.out}: {arguments.trajectories} trajectories of {recipe.frames} frames")


def _recipe(arguments: Arguments) -> Recipe:
    regimes: dict = {"free": 1.0}
    if arguments.actuated:
        regimes = _ACTUATED_MIX if arguments.excitation == "mix" else {arguments.excitation: 1.0}
    frames = arguments.frames or (200 if arguments.actuated else 100)
    return Recipe(arguments.system, frames, regimes, arguments.seed, arguments.vary, arguments.high)


def _fill(file: h5py.File, recipe: Recipe, arguments: Arguments) -> None:
    count, frames = arguments.trajectories, recipe.frames
    nx = 2 * build_system(recipe.system).model.nv
    p = 1 if arguments.actuated else 0
    shape = (frames, IMAGE_SIZE, IMAGE_SIZE)
    images = file.create_dataset(
        recording.FRAMES_DATASET,
        (count, *shape),
        np.uint8,
        chunks=(1, *shape),
        **hdf5plugin.Zstd(3),
    )
    controls = file.create_dataset(recording.CONTROLS_DATASET, (count, frames - 1, p), np.float64)
    states = file.create_dataset(recording.STATES_DATASET, (count, frames, nx), np.float64)
    manifest = []
    samples = generate(recipe, count, arguments.workers)
    for i, sample in enumerate(tqdm(samples, total=count, unit="trajectory", file=sys.stderr)):
        images[i] = sample.trajectory.frames
        controls[i] = sample.trajectory.controls[:, :p]
        states[i] = sample.trajectory.states
        manifest.append({"regime": sample.regime, **sample.parameters})
    file.attrs.update(
        {
            recording.FORMAT_ATTRIBUTE: recording.RECORDING_FORMAT,
            recording.VERSION_ATTRIBUTE: recording.RECORDING_VERSION,
            recording.SYSTEM_ATTRIBUTE: recipe.system,
            recording.ACTUATED_ATTRIBUTE: arguments.actuated,
            recording.RENDERER_ATTRIBUTE: RENDERER,
            recording.DT_ATTRIBUTE: FRAME_INTERVAL,
            recording.SEED_ATTRIBUTE: recipe.seed,
        }
    )
    # An attribute holds at most 64 KB: the manifest, a line a trajectory, is a data set.
    lines = [json.dumps(entry) for entry in manifest]
    file.create_dataset(recording.PARAMETERS_DATASET, data=lines, dtype=h5py.string_dtype())


if __name__ == "__main__":
    main()
