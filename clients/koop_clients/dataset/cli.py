"""Command line of `koop-dataset`."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from koop_clients.dataset.generate import Recipe, generate
from koop_clients.mechanics.excitation import Regime
from koop_clients.mechanics.rendering import RENDERER
from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.mechanics.systems import build_system, default_parameters

try:
    from tqdm import tqdm

    from koop_clients.recording.file import Header, Row, write_recording
except ModuleNotFoundError as error:
    sys.exit(f"koop-dataset needs {error.name}: pip install 'koop[train]'")

# Actuated sets mix regimes: probing and soft ones identify A and B in the region where control
# acts and around the hanging position, and free swings show what a plant does with its motor off.
_ACTUATED_MIX: dict[Regime, float] = {
    "paper": 0.3,
    "probing": 0.25,
    "soft": 0.15,
    "soft-hanging": 0.15,
    "free": 0.15,
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
    excitation: Literal["mix", "paper", "probing", "soft", "soft-hanging", "free"] = "mix"
    """How an actuated plant is driven: the paper's tight tracking, tracking with a probing torque,
    softly with more of it (near upright or hanging), free with its motor off, or a mix of probing,
    soft, soft-hanging and free."""
    vary: bool = False
    """Draw masses and lengths anew for each trajectory."""
    high: bool = False
    """Free plants start anywhere in [0, 2 pi], not only in [pi/2, 3 pi/2]."""
    change_at: int = 0
    """Number of the first frame after a change in mid-stream; 0 changes nothing."""
    change: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PARAMETER:FACTOR ...")] = ()
    """What that change multiplies, and by what: mass:1.5 length:0.8."""
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
    header = Header(
        recipe.system,
        RENDERER,
        FRAME_INTERVAL,
        control_size=int(arguments.actuated),
        state_size=2 * build_system(recipe.system).model.nv,
        seed=recipe.seed,
    )
    rows = _rows(recipe, arguments)
    write_recording(arguments.out, header, arguments.trajectories, recipe.frames, rows)
    print(f"wrote {arguments.out}: {arguments.trajectories} trajectories of {recipe.frames} frames")


def _rows(recipe: Recipe, arguments: Arguments) -> Iterator[Row]:
    count, p, outside = arguments.trajectories, int(arguments.actuated), 0
    samples = generate(recipe, count, arguments.workers)
    for sample in tqdm(samples, total=count, unit="trajectory", file=sys.stderr):
        run = sample.trajectory
        outside += sample.leaves_picture
        yield Row(run.frames, run.controls[:, :p], run.states, sample.manifest)
    if outside:
        print(f"note: {outside} of {count} trajectories leave the picture", file=sys.stderr)


def _recipe(arguments: Arguments) -> Recipe:
    frames = arguments.frames or (200 if arguments.actuated else 100)
    if bool(arguments.change) != bool(arguments.change_at):
        raise ValueError("--change and --change-at go together: --change-at 150 --change mass:1.5")
    if arguments.change and not 1 <= arguments.change_at < frames:
        raise ValueError(
            f"--change-at is {arguments.change_at}; expected a frame from 1 to {frames - 1}"
        )
    return Recipe(
        arguments.system,
        frames,
        _regimes(arguments),
        arguments.seed,
        arguments.vary,
        arguments.high,
        arguments.change_at,
        dict(_factor(text, arguments.system) for text in arguments.change),
    )


def _regimes(arguments: Arguments) -> Mapping[Regime, float]:
    asked = arguments.excitation
    if arguments.actuated:
        return _ACTUATED_MIX if asked == "mix" else {asked: 1.0}
    if asked not in ("mix", "free"):
        raise ValueError(f"--excitation {asked} needs a motor: add --actuated")
    return {"free": 1.0}


def _factor(text: str, system: str) -> tuple[str, float]:
    """Parameter and factor of "mass:1.5"."""
    name, _, number = text.partition(":")
    defaults = default_parameters(system)
    known = [key for key, value in defaults.items() if value > 0]  # zero has no multiples
    if name not in known:
        raise ValueError(f"--change {text}: {system} has {', '.join(known)} to change")
    try:
        factor = float(number)
    except ValueError:
        factor = math.nan
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"--change {text}: expected a factor above 0, as in {name}:1.5")
    return name, factor


if __name__ == "__main__":
    main()
