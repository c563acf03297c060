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
from koop_clients.flow.cylinder import DivergedError
from koop_clients.flow.settings import REYNOLDS, FlowSettings
from koop_clients.mechanics.excitation import Regime
from koop_clients.mechanics.rendering import RENDERER
from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.mechanics.systems import build_system, default_parameters

try:
    from tqdm import tqdm

    from koop_clients.dataset.bars import Bar
    from koop_clients.dataset.flow import write_flow
    from koop_clients.dataset.moments import FlowRecipe
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


# What only one kind of system knows.
_MECHANICAL = ("vary", "high", "change_at", "change")
_FLOWING = ("reynolds", "rotation", "steady")


def _unset(metavar: str, otherwise: str) -> object:
    """An option that stays None unless given."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {otherwise})")


_TRAJECTORIES = 1000


@dataclass(frozen=True)
class Arguments:
    """Simulate and draw a training set, and write it as one HDF5 file."""

    system: Literal["pendulum", "double-pendulum", "cartpole", "cylinder"]
    """Which plant; the cylinder stands in a flow."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The HDF5 file to write."""
    trajectories: Annotated[int | None, _unset("INT", "1000; 1 of the cylinder")] = None
    """How many trajectories."""
    frames: int = 0
    """Frames in each (50 ms apart); 0 takes the paper's 100, or 200 when actuated; of the cylinder
    4328, or 5000."""
    actuated: bool = False
    """Drive the pole's joint, as the paper's section 3.3 does, or turn the cylinder."""
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
    reynolds: Annotated[float | None, _unset("FLOAT", f"{REYNOLDS:g}")] = None
    """Reynolds number of the flow past the cylinder."""
    rotation: Annotated[
        tuple[Literal["chirp", "sweeps", "schedule", "feedback", "mix"], ...],
        tyro.conf.arg(metavar="REGIME ...", help_behavior_hint="(default: schedule)"),
    ] = ()
    """How an actuated cylinder turns: by the paper's one long chirp, by random slow sweeps like it,
    by a random schedule of faster chirps and holds, by the controller that calms the wake (with
    some of that schedule on top), or by schedule and controller in turn (mix). Of several, the
    trajectories take one each in turn."""
    steady: bool = False
    """The cylinder's steady flow instead, which control aims at."""
    seed: int = 0
    """Seed; the same seed gives the same file."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Processes, among which trajectories are shared out."""


def main() -> None:
    """Entry point."""
    arguments = tyro.cli(Arguments, prog="koop-dataset")
    try:
        write(arguments)
    except (OSError, ValueError, DivergedError) as error:
        sys.exit(f"koop-dataset: {error}")


def write(arguments: Arguments) -> None:
    """Generate the set and write it to `arguments.out` (replaced only once it is complete)."""
    asked = arguments.trajectories
    if (asked is not None and asked < 1) or arguments.frames < 0:
        raise ValueError("--trajectories must be at least 1 and --frames not negative")
    _check_options(arguments)
    if arguments.system == "cylinder":
        _write_flow(arguments)
    else:
        _write_mechanics(arguments)


def _write_mechanics(arguments: Arguments) -> None:
    recipe = _recipe(arguments)
    count = arguments.trajectories or _TRAJECTORIES
    header = Header(
        recipe.system,
        RENDERER,
        FRAME_INTERVAL,
        control_size=int(arguments.actuated),
        state_size=2 * build_system(recipe.system).model.nv,
        seed=recipe.seed,
    )
    rows = _rows(recipe, arguments, count)
    write_recording(arguments.out, header, count, recipe.frames, rows)
    print(f"wrote {arguments.out}: {count} trajectories of {recipe.frames} frames")


def _check_options(arguments: Arguments) -> None:
    """Nothing may be asked of one kind of system that only the other knows."""
    flows = arguments.system == "cylinder"
    foreign = [name for name in (_MECHANICAL if flows else _FLOWING) if getattr(arguments, name)]
    if flows and arguments.excitation != "mix":
        foreign.append("excitation")
    if foreign:
        option = foreign[0].replace("_", "-")
        others = "the mechanical systems" if flows else "the cylinder"
        raise ValueError(f"--{option} is for {others}; leave it out with --system "
                         f"{arguments.system}")  # fmt: skip


def _write_flow(arguments: Arguments) -> None:
    recipe = _flow_recipe(arguments)
    count, length = recipe.trajectories, recipe.length
    with Bar("the flow develops", "frame") as first, Bar("", "frame", count * length) as bar:
        write_flow(arguments.out, recipe, first.stand, bar.count, arguments.workers)
    plural = "y" if count == 1 else "ies"
    print(f"wrote {arguments.out}: {count} trajector{plural} of {length} frames")


def _flow_recipe(arguments: Arguments) -> FlowRecipe:
    if arguments.rotation and not arguments.actuated:
        raise ValueError(f"--rotation {arguments.rotation[0]} needs a motor: add --actuated")
    if arguments.steady and arguments.actuated:
        raise ValueError("--steady is the flow past a cylinder at rest; leave --actuated out")
    still = "steady" if arguments.steady else "rest"
    turning = arguments.rotation or ("schedule",)
    return FlowRecipe(
        FlowSettings(reynolds=REYNOLDS if arguments.reynolds is None else arguments.reynolds),
        turning if arguments.actuated else (still,),
        arguments.trajectories or len(arguments.rotation) or 1,
        arguments.frames,
        arguments.seed,
    )


def _rows(recipe: Recipe, arguments: Arguments, count: int) -> Iterator[Row]:
    p, outside = int(arguments.actuated), 0
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
