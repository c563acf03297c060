"""Which model encodes which trajectory: the bundled models, and the user's before them."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from importlib import resources
from pathlib import Path

from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard, fingerprint, load_card, load_weights

# Names of the trajectories that koop-sim-client streams, by the system of the bundled model.
_BUNDLED_PATTERNS = {"cartpole-actuated": ("cartpole/*",)}


@dataclass(frozen=True)
class ModelEntry:
    """One set of weights and the trajectories that it is for (shell patterns, `*` crosses `/`)."""

    name: str
    path: Path
    patterns: tuple[str, ...]

    @cached_property
    def card(self) -> ModelCard:
        """The model card. Raises ValueError for a file that is not a koop model."""
        return load_card(self.path)

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
        folder = Path(str(resources.files("koop_service"))) / "weights"
        paths = sorted(folder.glob("*.safetensors"))
        return cls([ModelEntry(p.stem, p, _BUNDLED_PATTERNS.get(p.stem, ())) for p in paths])

    def preferring(self, entries: list[ModelEntry]) -> Catalogue:
        """A catalogue that looks at `entries` first."""
        return Catalogue([*entries, *self.entries])

    def match(self, trajectory: str) -> ModelEntry | None:
        """The model for `trajectory`, or None."""
        return next((entry for entry in self.entries if entry.matches(trajectory)), None)
