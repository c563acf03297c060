"""Command line of `koop-train`."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, cast

import numpy as np
import torch
import tyro
from torch import Tensor

from koop_service.encoding.autoencoder import Autoencoder
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import (
    FITTED,
    EstimatorDefaults,
    ModelCard,
    fingerprint,
    load_card,
    load_weights,
    save_weights,
)

try:
    from koop_service.learning import hardware
    from koop_service.learning.dynamics import load_learned
    from koop_service.learning.evaluation import frames_needed
    from koop_service.learning.judging import judged, prior_mean
    from koop_service.learning.parallel import joined
    from koop_service.learning.presets import PRESETS, Preset, with_regime
    from koop_service.learning.recording import Recording, load_recording
    from koop_service.learning.session import Files, InterruptedTrainingError, Session, say
    from koop_service.learning.train import Setting, Training, Warm, begin
except ModuleNotFoundError as error:
    sys.exit(f"koop-train needs {error.name}: pip install 'koop[train]'")


@dataclass(frozen=True)
class Arguments:
    """Train an autoencoder on a recording, so that its codes evolve linearly."""

    recording: tyro.conf.Positional[Path]
    """An HDF5 recording (koop-dataset and koop-record write one)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The weights to write (safetensors)."""
    preset: Literal["cpu", "paper", "flow", "flow-gpu", "smoke"] = "cpu"
    """Schedule: cpu (a quarter of an hour on 2 cores), paper (a GPU's), flow (fields of 128 x 256,
    short windows of long trajectories), flow-gpu (a GPU's for those) or smoke (seconds)."""
    dynamics: Literal["fitted", "learned-A", "learned-B"] = "fitted"
    """fitted to each trajectory (ours), or learned for all: the baselines [17] (A) and [6] (B)."""
    regime: Literal["offline", "partial", "full"] | None = None
    """Updates of the fit inside the training roll-out; without it, the preset's roll-out."""
    seed: int = 0
    """Seed; the same seed, machine and thread count give the same weights."""
    start_from: Path | None = None
    """Weights to go on from, with what their dynamics learned; the autoencoder is trained alone
    only if --warm-up says so, and what was learned for its codes is then learned anew."""
    code_size: int | None = None
    """Numbers in a code (n_z), 8 in the presets."""
    warm_up: int | None = None
    """Steps of the first stage, the autoencoder alone, instead of the preset's."""
    steps: int | None = None
    """Steps of the second stage, with the dynamics, instead of the preset's."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes a GPU if there is one."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """The network's arithmetic; auto is bfloat16 on a GPU, float32 elsewhere."""
    threads: int = 0
    """Threads; 0 lets torch choose."""
    checkpoint_seconds: float = 120.0
    """Time between two checkpoints, each with an early look (a strip of predictions) [s]."""
    judged_on: Path | None = None
    """A recording to judge on, instead of what is held out of the one that is trained on."""
    fresh: bool = False
    """Start over, also where a checkpoint of an unfinished training with this --out is found."""


def main() -> None:
    """Entry point."""
    arguments = tyro.cli(Arguments, prog="koop-train")
    hardware.tune_allocator()
    try:
        run(arguments)
    except InterruptedTrainingError as stopped:
        say(str(stopped))
        sys.exit(128 + stopped.number)
    except (OSError, ValueError) as error:
        sys.exit(f"koop-train: {error}")


def run(arguments: Arguments) -> None:
    """Load, train, judge on held-out trajectories, and write the weights."""
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    _check_writable(arguments.out)
    recording = load_recording(arguments.recording)
    start = arguments.start_from
    warm = _start(start, recording, arguments.dynamics) if start else None
    preset = chosen_preset(arguments, warm.model if warm else None)
    _check_shape(arguments, recording, preset)
    seen, unseen = preset.split(recording)
    if arguments.judged_on:
        unseen = preset.sequences(_alike(arguments.judged_on, recording))
    preset = preset.on(seen)
    _check_recording(arguments, seen, preset)
    _check_unseen(arguments, unseen, preset)
    with joined(arguments.device) as (group, local_rank):
        machine = hardware.choose(arguments.device, arguments.precision, local_rank)
        setting = Setting(seen, preset, arguments.seed, machine, group, say)
        training = begin(setting, arguments.dynamics, warm)
        identity = begun_with(arguments, setting)
        files, every = Files(arguments.out), arguments.checkpoint_seconds
        session = Session(training, setting, files, identity, unseen, every)
        session.resume(arguments.fresh)
        session.run()
    if group.leads:
        finish(session, model_card(recording, preset, arguments))


def finish(session: Session, card: ModelCard) -> None:
    """Judge the trained model, write it, and drop the checkpoint."""
    training, files = session.training, session.files
    training.model.to("cpu")
    training.dynamics.to("cpu")
    view = session.look(len(session.unseen.frames))
    matrix = training.dynamics.matrix
    if card.dynamics == FITTED:
        codec = ImageCodec(training.model, card)
        mean = prior_mean(training, codec, session.setting.recording)
        card, matrix = judged(codec, session.unseen, mean), None
    card = dataclasses.replace(card, figures={**card.figures, **view.errors()})
    save_weights(files.out, training.model, card, matrix)
    files.checkpoint.unlink(missing_ok=True)
    beside = [path.name for path in (files.log, files.strip) if path.exists()]
    print(f"wrote {', '.join([str(files.out), *beside])}: {summary(card, training)}")


def summary(card: ModelCard, training: Training) -> str:
    """The figures that matter, in one line."""
    offline = cast("dict[int, float]", card.figures["offline"])
    repeated = cast("dict[int, float]", card.figures["offline_repeat_last"])
    steps = ", ".join(f"{k}: {offline[k]:.4f} ({offline[k] / repeated[k]:.2f})" for k in offline)
    rate = training.frames / max(training.seconds, 1e-9)
    return (
        f"RMSE by frames after the fit, never updated (over repeating the last frame) {steps}; "
        f"{training.seconds / 60:.1f} minutes, {rate:,.0f} frames/s"
    )


def begun_with(arguments: Arguments, setting: Setting) -> dict[str, object]:
    """All that decides what the weights become, except the number of threads."""
    preset = dataclasses.asdict(setting.preset)
    stages = {
        f"{name}.{key}": value
        for name, part in preset.items()
        if isinstance(part, dict)
        for key, value in part.items()
    }
    start = arguments.start_from
    return {
        **{name: value for name, value in preset.items() if not isinstance(value, dict)},
        **stages,
        "recording": fingerprint(arguments.recording),
        "start from": fingerprint(start) if start else None,
        "dynamics of": arguments.dynamics,
        "seed": arguments.seed,
        "device": setting.hardware.device.type,
        "precision": str(setting.hardware.precision),
        "processes": setting.group.size,
    }


def chosen_preset(arguments: Arguments, warm: Autoencoder | None) -> Preset:
    """The preset with what the arguments change in it."""
    preset = PRESETS[arguments.preset]
    if arguments.regime:
        preset = with_regime(preset, arguments.regime)
    warm_up = arguments.warm_up if warm is None else arguments.warm_up or 0
    if warm_up is not None:
        stage = dataclasses.replace(preset.autoencoder, steps=warm_up, epochs=0)
        preset = dataclasses.replace(preset, autoencoder=stage)
    if arguments.steps is not None:
        stage = dataclasses.replace(preset.dynamics, steps=arguments.steps, epochs=0)
        preset = dataclasses.replace(preset, dynamics=stage)
    size = preset.code_size if warm is None else warm.code_size
    if warm is not None and arguments.code_size not in (None, size):
        raise ValueError(
            f"{arguments.start_from} has codes of size {size}, not --code-size "
            f"{arguments.code_size}; leave --code-size away, or train without --start-from"
        )
    architecture = preset.architecture if warm is None else warm.architecture
    return dataclasses.replace(
        preset, code_size=arguments.code_size or size, architecture=architecture
    )


def _check_shape(arguments: Arguments, recording: Recording, preset: Preset) -> None:
    """Raise ValueError where the preset's network is not for the recording's frames."""
    try:
        preset.architecture.remainder(*recording.image_shape[-2:])
    except ValueError as error:
        raise ValueError(f"{arguments.recording}: {error}") from error


def _check_recording(arguments: Arguments, recording: Recording, preset: Preset) -> None:
    """Raise ValueError where what is seen of the recording does not fit the preset."""
    count, length = recording.frames.shape[:2]
    roll = preset.roll_out(recording.controls.shape[2])
    if length < roll.longest:
        raise ValueError(
            f"{arguments.recording} has trajectories of {length} frames to train on; preset "
            f"{arguments.preset} fits up to {roll.fit_frames[1]} of them and needs "
            f"{roll.after(roll.horizon)} more, so at least {roll.longest}; record longer ones"
        )
    some = recording.frames[:: max(1, count // 64), ::10]
    if torch.equal(*torch.aminmax(torch.from_numpy(some))):
        raise ValueError(
            f"{arguments.recording} shows nothing: every pixel of every frame is "
            f"{some.max():g}; look at its frames, and record it again"
        )


def _check_unseen(arguments: Arguments, unseen: Recording, preset: Preset) -> None:
    """Raise ValueError where what is held out is too short to be judged: now, not after hours."""
    length, controls = unseen.frames.shape[1], unseen.controls.shape[2]
    defaults = EstimatorDefaults(history=preset.history)
    needed = frames_needed(defaults.settings(preset.code_size, controls))
    if length < needed:
        raise ValueError(
            f"{arguments.recording} is judged on sequences of {length} frames; codes of size "
            f"{preset.code_size} need {needed}: choose a smaller --code-size, or record longer ones"
        )


def _check_writable(out: Path) -> None:
    """Raise ValueError where `out` cannot be written: before hours of training, not after."""
    probe = out.with_name(out.name + ".partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"cannot write {out}: {error}; choose another --out") from error
    if out.is_dir():
        raise ValueError(f"{out} is a folder; --out names the weights file to write")


def _alike(path: Path, recording: Recording) -> Recording:
    """The recording at `path`. Raises ValueError where it shows something else than `recording`."""
    other = load_recording(path)
    shown = [(r.renderer, r.image_shape, r.controls.shape[2]) for r in (other, recording)]
    if shown[0] != shown[1]:
        raise ValueError(
            f"--judged-on {path} holds {shown[0]} (renderer, frames, controls), the recording to "
            f"train on {shown[1]}; judge on frames of the same kind"
        )
    return other


def _start(path: Path, recording: Recording, dynamics: str) -> Warm:
    model, card = load_weights(path)
    if card.renderer != recording.renderer:
        raise ValueError(
            f"{path} was trained on frames drawn by {card.renderer!r}, the recording holds frames "
            f"drawn by {recording.renderer!r}; train afresh, without --start-from"
        )
    if card.image_shape != recording.image_shape:
        raise ValueError(
            f"{path} was trained on frames {card.image_shape}, the recording holds frames "
            f"{recording.image_shape}; train afresh, without --start-from"
        )
    return Warm(model, _learned(path, card) if card.dynamics == dynamics else None)


def _learned(path: Path, card: ModelCard) -> Tensor | None:
    """What the weights' dynamics learned for all trajectories, if anything."""
    learned = load_learned(path)
    rows = learned.matrix if learned else np.array(card.estimator.prior_mean)
    return torch.from_numpy(rows) if rows.size else None


def model_card(recording: Recording, preset: Preset, arguments: Arguments) -> ModelCard:
    """Data, preset, seed and command of this training run, and of the one that it started from."""
    roll, start = preset.roll_out(recording.controls.shape[2]), arguments.start_from
    return ModelCard(
        system=recording.system,
        renderer=recording.renderer,
        dt=recording.dt,
        code_size=preset.code_size,
        image_shape=recording.image_shape,
        value_range=recording.value_range,
        architecture=preset.architecture,
        estimator=EstimatorDefaults(history=preset.history, rho=roll.rho),
        training={
            "trajectories": recording.frames.shape[0],
            "frames": recording.frames.shape[1],
            "data_seed": recording.seed,
            "seed": arguments.seed,
            "preset": {"name": arguments.preset, **dataclasses.asdict(preset)},
            "command": "koop-train " + shlex.join(sys.argv[1:]),
            "torch": torch.__version__,
            **({"started_from": load_card(start).training} if start else {}),
        },
        dynamics=arguments.dynamics,
    )


if __name__ == "__main__":
    main()
