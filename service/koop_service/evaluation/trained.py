"""The trained models that are evaluated, from a folder of weights; what is missing is skipped."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import fingerprint, load_weights
from koop_service.evaluation.systems import System
from koop_service.learning.dynamics import LearnedDynamics, load_learned


@dataclass(frozen=True, eq=False)
class LearnedBaseline:
    """An autoencoder and the dynamics that were learned with it."""

    codec: ImageCodec
    learned: LearnedDynamics


@dataclass(frozen=True, eq=False)
class Trained:
    """What there is for one system: our model, its file's hash, and the baseline if any."""

    codec: ImageCodec
    fingerprint: str
    baseline: LearnedBaseline | None


class MissingWeightsError(Exception):
    """There is no model to evaluate: a reason to skip the system, not to stop."""


def weights_path(folder: Path, system: System) -> Path:
    """Our model's file."""
    return folder / f"{system.name}.safetensors"


def baseline_path(folder: Path, system: System) -> Path:
    """The baseline's file."""
    return folder / "baselines" / f"{system.name}-{system.baseline}.safetensors"


def load(folder: Path, system: System) -> tuple[Trained, list[str]]:
    """The models of a system, and what was missing. Raises MissingWeightsError without ours."""
    path = weights_path(folder, system)
    if not path.exists():
        raise MissingWeightsError(f"there is no {path.name}; train one with koop-train --out")
    codec = ImageCodec(*load_weights(path))
    baseline, notes = _baseline(folder, system)
    return Trained(codec, fingerprint(path), baseline), notes


def _baseline(folder: Path, system: System) -> tuple[LearnedBaseline | None, list[str]]:
    if system.baseline is None:
        return None, []
    path = baseline_path(folder, system)
    if not path.exists():
        lacking = f"there is no baselines/{path.name}"
        return None, [f"{system.name} goes without {system.baseline}: {lacking}"]
    learned = load_learned(path)
    if learned is None or learned.kind != system.baseline:
        found = "no learned dynamics" if learned is None else learned.kind
        raise ValueError(f"{path} holds {found}; expected {system.baseline}")
    return LearnedBaseline(ImageCodec(*load_weights(path)), learned), []
