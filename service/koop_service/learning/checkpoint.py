"""An unfinished training on disk: safetensors, and JSON in the file's own metadata.

Random numbers, rates and horizons follow from the step, so weights, Adam's moments and the step are
all that it takes to go on with the same bits. Another thread count may round differently.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from koop_service.learning.train import Training

FORMAT = "koop-checkpoint-1"
_STATE = ("stage", "step", "frames", "seconds")


def checkpoint_path(out: Path) -> Path:
    """The checkpoint of the training that will write the weights `out`."""
    return out.with_name(out.name + ".checkpoint")


def save_checkpoint(path: Path, training: Training, identity: Mapping[str, object]) -> None:
    """Write `training` to `path`, atomically; `identity` says what it was begun with."""
    tensors = {
        **{f"model.{name}": tensor for name, tensor in training.model.state_dict().items()},
        **{f"dynamics.{name}": tensor for name, tensor in training.dynamics.state_dict().items()},
        **{
            f"moments.{index}.{name}": moment
            for index, moments in training.moments.items()
            for name, moment in moments.items()
        },
    }
    metadata = {
        "format": FORMAT,
        "identity": json.dumps(identity),
        "state": json.dumps({name: getattr(training, name) for name in _STATE}),
    }
    partial = path.with_name(path.name + ".partial")
    save_file({k: t.detach().cpu().contiguous() for k, t in tensors.items()}, partial, metadata)
    partial.replace(path)


def load_checkpoint(path: Path, training: Training, identity: Mapping[str, object]) -> None:
    """Bring `training`, just begun, to where the one in `path` was.

    Raises ValueError where that was begun with other arguments, or the file is no checkpoint.
    """
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if metadata.get("format") != FORMAT:
            raise ValueError(f"{path} is not a checkpoint of koop-train; --fresh starts over")
        _compare(path, json.loads(metadata["identity"]), identity)
        training.model.load_state_dict(_part(tensors, "model."))
        training.dynamics.load_state_dict(_part(tensors, "dynamics."))
        for name, value in json.loads(metadata["state"]).items():
            setattr(training, name, value)
    except (SafetensorError, KeyError, RuntimeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} cannot be read ({error}); --fresh starts over") from error
    for name, moment in _part(tensors, "moments.").items():
        index, kind = name.split(".")
        training.moments.setdefault(int(index), {})[kind] = moment


def _part(tensors: dict, prefix: str) -> dict:
    return {k.removeprefix(prefix): t for k, t in tensors.items() if k.startswith(prefix)}


def _compare(path: Path, begun: Mapping[str, object], asked: Mapping[str, object]) -> None:
    """Raise ValueError naming what differs. Both went, or go, through JSON."""
    asked = json.loads(json.dumps(asked))
    differing = [
        f"{name}: {begun.get(name)!r} then, {asked.get(name)!r} now"
        for name in sorted({*begun, *asked})
        if begun.get(name) != asked.get(name)
    ]
    if differing:
        raise ValueError(
            f"{path} is of a training begun with other arguments ({'; '.join(differing)}); repeat "
            "those to go on with it, choose another --out, or start over with --fresh"
        )
