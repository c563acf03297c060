"""What a study works with: models, test sets and somewhere to say what is missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import load_weights
from koop_service.evaluation.assessment import check_fit
from koop_service.evaluation.datasets import TestSet, test_set
from koop_service.evaluation.systems import System
from koop_service.evaluation.trained import weights_path


@dataclass(frozen=True, eq=False)
class Bench:
    """Folders of weights and of test sets, how many trajectories, and `say` for the user."""

    weights: Path
    data: Path
    trajectories: int
    seed: int
    say: Callable[[str], None]

    def codec(self, system: System) -> ImageCodec | None:
        """The system's model, or None (and a word about it) where there is none."""
        return self.codec_at(weights_path(self.weights, system))

    def codec_at(self, path: Path) -> ImageCodec | None:
        """The model in a file, or None (and a word about it) where there is none."""
        if not path.exists():
            self.say(f"there is no {path.relative_to(self.weights)}: left out")
            return None
        return ImageCodec(*load_weights(path))

    def test(self, system: System, codec: ImageCodec) -> TestSet:
        """Unseen trajectories. Raises ValueError where the model was trained on other pictures."""
        found = test_set(system, self.trajectories, self.seed, self.data)
        check_fit(codec, found)
        return found
