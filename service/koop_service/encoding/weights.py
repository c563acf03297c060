"""Weights on disk: safetensors, with the model card in the file's own metadata."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from koop_service.encoding.architecture import PAPER, Architecture
from koop_service.encoding.autoencoder import IMAGE_SIZE, Autoencoder, channels_first
from koop_service.estimation.settings import EstimatorSettings, Rows
from koop_service.prediction.uncertainty import SCALE_HORIZONS

FORMAT = "koop-autoencoder-1"
FITTED = "fitted"
"""`ModelCard.dynamics` of a model whose dynamics are fitted to each trajectory as it streams."""
UNIT = (0.0, 1.0)
"""`ModelCard.value_range` of pictures."""
DYNAMICS_TENSOR = "dynamics.matrix"
"""The learned part of any other model's dynamics; `koop_service.learning.dynamics` reads it."""


@dataclass(frozen=True)
class EstimatorDefaults:
    """The estimator settings that a model was trained and evaluated with.

    `band_scale`: factors of a prediction's standard deviations at `SCALE_HORIZONS`, measured on
    held-out trajectories with these settings; empty where none were.
    `prior_mean`: the Theta (n, d) of all training trajectories together, for estimators with the
    controls that it was learned with; empty where the prior is centred on zero.
    """

    history: int = 2
    rho: float = 1e-2
    forgetting: float = 1.0
    affine: bool = True
    band_scale: tuple[float, ...] = ()
    prior_mean: Rows = field(default=(), repr=False)

    def __post_init__(self) -> None:
        good = all(math.isfinite(factor) and factor > 0 for factor in self.band_scale)
        if not good or len(self.band_scale) not in (0, len(SCALE_HORIZONS)):
            raise ValueError(
                f"band_scale is {self.band_scale}; expected {len(SCALE_HORIZONS)} positive factors,"
                f" for {SCALE_HORIZONS} steps ahead, or none"
            )
        if not isinstance(self.affine, bool):
            raise ValueError(f"affine is {self.affine!r}; expected true or false")
        self.settings(code_size=1, control_size=0)

    def settings(self, code_size: int, control_size: int) -> EstimatorSettings:
        """The estimator settings for codes and controls of these sizes."""
        d = self.history * code_size + control_size + int(self.affine)
        fitting = len(self.prior_mean) == code_size and len(self.prior_mean[0]) == d
        return EstimatorSettings(
            code_size=code_size,
            history=self.history,
            control_size=control_size,
            affine=self.affine,
            rho=self.rho,
            forgetting=self.forgetting,
            prior_mean=self.prior_mean if fitting else (),
        )

    def check_prior_mean(self, code_size: int) -> None:
        """Raises ValueError unless the prior's mean is none, or a Theta of codes of this size."""
        if self.prior_mean:
            columns = len(self.prior_mean[0])
            controls = columns - self.history * code_size - int(self.affine)
            sizes = self.settings(code_size, max(controls, 0))
            replace(sizes, prior_mean=self.prior_mean)


@dataclass(frozen=True)
class ModelCard:
    """What a user must know of a set of weights.

    `renderer` drew the training frames ("" for a real camera); `dt` is the frame interval [s];
    `training` records data, preset, seed and command; `figures` what was measured on unseen data.
    `dynamics` is FITTED, or the baseline that was learned in its place. `image_shape` is (H, W) or
    (C, H, W). Frames of floats have values in `value_range`; where it is UNIT they may be uint8
    too, in 255ths.
    """

    system: str
    renderer: str
    dt: float
    code_size: int = 8
    image_shape: tuple[int, ...] = (IMAGE_SIZE, IMAGE_SIZE)
    estimator: EstimatorDefaults = field(default_factory=EstimatorDefaults)
    training: Mapping[str, object] = field(default_factory=dict)
    figures: Mapping[str, object] = field(default_factory=dict)
    dynamics: str = FITTED
    value_range: tuple[float, float] = UNIT
    architecture: Architecture = PAPER

    def __post_init__(self) -> None:
        if type(self.code_size) is not int or self.code_size < 1:
            raise ValueError(f"code_size is {self.code_size!r}; expected 1 number or more")
        sides = all(type(side) is int and side >= 1 for side in self.image_shape)
        if len(self.image_shape) not in (2, 3) or not sides:
            raise ValueError(f"image_shape is {self.image_shape}; expected (H, W) or (C, H, W)")
        if not (math.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"dt is {self.dt} s between frames; expected a positive time")
        for name in ("system", "renderer", "dynamics"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected text")
        self.estimator.check_prior_mean(self.code_size)
        self.architecture.remainder(*channels_first(self.image_shape)[1:])
        low, high = self.value_range
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"value_range is {self.value_range}; expected two rising numbers")


def save_weights(
    path: Path, model: Autoencoder, card: ModelCard, dynamics: Tensor | None = None
) -> None:
    """Write weights and card to `path`, atomically; `dynamics` is what a baseline learned."""
    if (dynamics is None) != (card.dynamics == FITTED):
        raise ValueError(f"dynamics {card.dynamics!r} and the learned matrix do not go together")
    metadata = {"format": FORMAT, "card": json.dumps(asdict(card))}
    partial = path.with_name(path.name + ".partial")
    learned = {} if dynamics is None else {DYNAMICS_TENSOR: dynamics}
    tensors = {**model.state_dict(), **learned}
    tensors = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    save_file(tensors, partial, metadata)
    partial.replace(path)


def load_card(path: Path) -> ModelCard:
    """The model card of a weights file. Raises ValueError where it is not one of koop's."""
    try:
        with safe_open(path, "pt") as file:
            return _card(path, file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path} cannot be read as safetensors: {error}") from error


def load_weights(path: Path) -> tuple[Autoencoder, ModelCard]:
    """Model in evaluation mode, and its card. Raises ValueError where the file does not fit."""
    card = load_card(path)
    try:
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        tensors.pop(DYNAMICS_TENSOR, None)
        with torch.device("meta"):
            # Nothing is allocated for what a card claims before the file bears it out.
            Autoencoder(card.code_size, card.image_shape, card.architecture).load_state_dict(
                tensors, assign=True
            )
        model = Autoencoder(card.code_size, card.image_shape, card.architecture)
        model.load_state_dict(tensors)
    except (SafetensorError, RuntimeError, TypeError) as error:
        raise ValueError(
            f"{path} does not hold the weights that its card names: {error}"
        ) from error
    if not all(bool(torch.isfinite(t).all()) for t in tensors.values()):
        raise ValueError(f"{path} holds weights that are not finite")
    return model.eval(), card


def fingerprint(path: Path) -> str:
    """A hash of the file's bytes: which weights a stored estimator state was computed with."""
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def _card(path: Path, metadata: Mapping[str, str]) -> ModelCard:
    if metadata.get("format") != FORMAT:
        raise ValueError(
            f"{path} is not a koop autoencoder: its metadata says format "
            f"{metadata.get('format')!r}, expected {FORMAT!r}; train one with koop-train"
        )
    try:
        fields = json.loads(metadata["card"])
        fields["estimator"] = _estimator(fields["estimator"])
        # JSON has lists; and cards written before there were fields of floats have only pictures.
        fields["image_shape"] = tuple(fields["image_shape"])
        fields["value_range"] = tuple(fields.get("value_range", UNIT))
        if "architecture" in fields:
            fields["architecture"] = Architecture.from_fields(fields["architecture"])
        return ModelCard(**fields)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path} has a model card that cannot be read: {error}") from error


def _estimator(fields: Mapping[str, Any]) -> EstimatorDefaults:
    # JSON has lists; and older cards have neither factors of bands nor a prior's mean.
    known = {"band_scale": (), "prior_mean": (), **fields}
    known["band_scale"] = tuple(known["band_scale"])
    known["prior_mean"] = tuple(tuple(map(float, row)) for row in known["prior_mean"])
    return EstimatorDefaults(**known)
