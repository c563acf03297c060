"""Which model encodes which trajectory: the bundled models, and the user's before them."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from importlib import resources
from pathlib import Path

from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import FITTED, ModelCard, fingerprint, load_card, load_weights

# A bundled model is for the trajectories under its own name, and some for others besides.
_FURTHER_PATTERNS = {"pendulum-low": ("pendulum/*",)}


@dataclass(frozen=True)
class ModelEntry:
    """One set of weights and the trajectories that it is for (shell patterns, `*` crosses `/`)."""

    name: str
    path: Path
    patterns: tuple[str, ...]

    @cached_property
    def card(self) -> ModelCard:
        """The model card. Raises ValueError for a file that is no koop model, or a baseline."""
        card = load_card(self.path)
        if card.dynamics != FITTED:
            raise ValueError(
                f"{self.path} is a baseline with {card.dynamics} dynamics; the service fits the "
                "dynamics to each trajectory: serve a model trained with --dynamics fitted"
            )
        return card

    @cached_property
    def fingerprint(self) -> str:
        """A hash of the weights file."""
        return fingerprint(self.path)

    def matches(self, trajectory: str) -> bool:
        """Whether this model is for `trajectory`."""
        return any(fnmatchcase(trajectory, pattern) for pattern in self.patterns)

    def load(self, device: str = "cpu") -> ImageCodec:
        """Read the weights and make them ready for inference."""
        model, card = load_weights(self.path)
        return ImageCodec(model, card, device)


class Catalogue:
    """An ordered list of models; the first whose pattern matches a trajectory is its model."""

    def __init__(self, entries: list[ModelEntry]) -> None:
        self.entries = entries

    @classmethod
    def bundled(cls) -> Catalogue:
        """The models in the package."""
        paths = sorted(bundled_folder().glob("*.safetensors"))
        return cls([ModelEntry(p.stem, p, _bundled_patterns(p.stem)) for p in paths])

    def preferring(self, entries: list[ModelEntry]) -> Catalogue:
        """A catalogue that looks at `entries` first."""
        return Catalogue([*entries, *self.entries])

    def match(self, trajectory: str) -> ModelEntry | None:
        """The model for `trajectory`, or None."""
        return next((entry for entry in self.entries if entry.matches(trajectory)), None)


def bundled_folder() -> Path:
    """Where the package's own weights are."""
    return Path(str(resources.files("koop_service"))) / "weights"


def bundled_or_own(path: Path, folder: Path = Path()) -> Path:
    """`path` in `folder`, or the bundled weights of that name where there is no such file."""
    bundled, own = bundled_folder() / f"{path}.safetensors", folder / path
    return bundled if bundled.exists() and not own.exists() else own


def _bundled_patterns(name: str) -> tuple[str, ...]:
    return (f"{name}/*", *_FURTHER_PATTERNS.get(name, ()))
