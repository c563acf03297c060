"""Learning rate and horizon as functions of the step alone: a resumed run needs no memory."""

from __future__ import annotations

import math

import numpy as np

from koop_service.learning.presets import Preset, RollOut, Stage

_LEAST = 0.01  # of the rate, where a cosine ends


def learning_rate(stage: Stage, step: int) -> float:
    """The rate of Adam at `step` of `stage`."""
    share = step / stage.steps
    if stage.halvings:
        return stage.rate * 0.5 ** math.floor(share * stage.halvings)
    return stage.rate * (_LEAST + (1 - _LEAST) * (1 + math.cos(math.pi * share)) / 2)


def growing_horizon(step: int, preset: Preset, roll_out: RollOut) -> int:
    """From 1 to the roll-out's horizon over the first `preset.growth` of the dynamics' steps."""
    share = min(1.0, step / max(1.0, preset.growth * preset.dynamics.steps))
    return 1 + round(share * (roll_out.horizon - 1))


def drawn_horizon(longest: int, roll_out: RollOut, rng: np.random.Generator) -> int:
    """`longest` or, where the roll-out has a `shortest`, between them, each octave as likely."""
    if not roll_out.shortest or roll_out.shortest >= longest:
        return longest
    return int(np.exp(rng.uniform(*np.log([roll_out.shortest, longest + 1]))))


def mean_horizon(longest: int, roll_out: RollOut) -> int:
    """What `drawn_horizon` gives on average, about."""
    if not roll_out.shortest or roll_out.shortest >= longest:
        return longest
    return round((longest - roll_out.shortest) / math.log(longest / roll_out.shortest))
