"""Command line of `koop-train`."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from koop_service.encoding.autoencoder import Autoencoder
from koop_service.encoding.weights import EstimatorDefaults, ModelCard, save_weights
from koop_service.learning.presets import PRESETS, Preset
from koop_service.learning.recording import Recording, load_recording
from koop_service.learning.train import train


@dataclass(frozen=True)
class Arguments:
    """Train an autoencoder on a recording, so that its codes evolve linearly."""

    recording: tyro.conf.Positional[Path]
    """An HDF5 recording (koop-dataset writes one)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The weights to write (safetensors)."""
    preset: str = "cpu"
    """Schedule: cpu (about an hour on 2 cores) or smoke (seconds, to see that all is well)."""
    seed: int = 0
    """Seed; the same seed, machine and thread count give the same weights."""
    threads: int = 0
    """Threads; 0 lets torch choose."""


def main() -> None:
    """Entry point."""
    arguments = tyro.cli(Arguments, prog="koop-train")
    try:
        run(arguments)
    except (OSError, ValueError) as error:
        sys.exit(f"koop-train: {error}")


def run(arguments: Arguments) -> None:
    """Load, train, and write the weights (also every hundred steps on the way)."""
    if arguments.preset not in PRESETS:
        raise ValueError(f"unknown preset {arguments.preset!r}; there are {', '.join(PRESETS)}")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    preset = PRESETS[arguments.preset]
    recording = load_recording(arguments.recording)
    needed = preset.fit_frames + preset.horizon + 4
    if recording.frames.shape[1] < needed:
        raise ValueError(
            f"{arguments.recording} has trajectories of {recording.frames.shape[1]} frames; "
            f"preset {arguments.preset} needs at least {needed}"
        )
    card = model_card(recording, preset, arguments)

    def keep(model: Autoencoder) -> None:
        save_weights(arguments.out, model, card)

    keep(train(recording, preset, arguments.seed, keep))
    print(f"wrote {arguments.out}")


def model_card(recording: Recording, preset: Preset, arguments: Arguments) -> ModelCard:
    """Data, preset, seed and command of this training run."""
    return ModelCard(
        system=recording.system,
        renderer=recording.renderer,
        dt=recording.dt,
        code_size=preset.code_size,
        estimator=EstimatorDefaults(history=preset.history, rho=preset.rho),
        training={
            "trajectories": recording.frames.shape[0],
            "frames": recording.frames.shape[1],
            "data_seed": recording.seed,
            "seed": arguments.seed,
            "preset": dataclasses.asdict(preset),
            "command": "koop-train " + shlex.join(sys.argv[1:]),
            "torch": torch.__version__,
        },
    )


if __name__ == "__main__":
    main()
