"""Command line of `koop-train`."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from koop_service.encoding.autoencoder import Autoencoder
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import EstimatorDefaults, ModelCard, load_weights, save_weights
from koop_service.learning.presets import PRESETS, Preset

try:
    from koop_service.learning.evaluation import encode_all, evaluate, select
    from koop_service.learning.recording import Recording, load_recording
    from koop_service.learning.train import train
except ModuleNotFoundError as error:
    sys.exit(f"koop-train needs {error.name}: pip install 'koop[train]'")

HELD_OUT = 0.04  # share of the trajectories, the last ones, that training never sees


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
    start_from: Path | None = None
    """Weights to go on from, instead of warming up a fresh autoencoder."""
    steps: int = 0
    """Steps of the second stage; 0 takes the preset's."""
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
    """Load, train, judge on held-out trajectories, and write the weights (also on the way)."""
    if arguments.preset not in PRESETS:
        raise ValueError(f"unknown preset {arguments.preset!r}; there are {', '.join(PRESETS)}")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    preset = PRESETS[arguments.preset]
    if arguments.steps:
        preset = dataclasses.replace(preset, steps=arguments.steps)
    recording = load_recording(arguments.recording)
    if recording.frames.shape[1] < preset.length:
        raise ValueError(
            f"{arguments.recording} has trajectories of {recording.frames.shape[1]} frames; "
            f"preset {arguments.preset} needs at least {preset.length}"
        )
    seen, unseen = recording.split(HELD_OUT)
    card = model_card(recording, preset, arguments)

    def keep(model: Autoencoder) -> None:
        save_weights(arguments.out, model, card)

    warm = _start(arguments.start_from, recording) if arguments.start_from else None
    model = train(seen, preset, arguments.seed, keep, warm)
    card = judged(ImageCodec(model, card), unseen)
    save_weights(arguments.out, model, card)
    print(f"wrote {arguments.out}\n{json.dumps(card.figures, indent=2)}")


def _start(path: Path, recording: Recording) -> Autoencoder:
    model, card = load_weights(path)
    if card.renderer != recording.renderer:
        raise ValueError(
            f"{path} was trained on frames drawn by {card.renderer!r}, the recording holds frames "
            f"drawn by {recording.renderer!r}; train afresh, without --start-from"
        )
    return model


def judged(codec: ImageCodec, unseen: Recording) -> ModelCard:
    """The codec's card with the best estimator settings, and figures, on `unseen`."""
    trajectories = encode_all(codec, unseen)
    chosen = select(trajectories, codec.card.estimator)
    figures = dataclasses.asdict(evaluate(codec, trajectories, chosen))
    return dataclasses.replace(codec.card, estimator=chosen, figures=figures)


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
