"""Results made up of known errors."""

from __future__ import annotations

import dataclasses

import numpy as np

from koop_service.encoding.weights import ModelCard
from koop_service.evaluation.fluid.assessment import SHOWN, Judged
from koop_service.evaluation.fluid.cases import FIT_FRAMES, TRAINED, WAKES, cases
from koop_service.evaluation.fluid.errors import Errors
from koop_service.evaluation.fluid.sequences import Units
from koop_service.evaluation.fluid.table import APART, OVERLAPPING, Splits

UNITS = Units(("rho", "rho u"), 0.2, 0.1, 0.25, (-2.0, 10.0, -3.0, 3.0), frame_time=0.8)
COUNT, LENGTH = 20, 116
KNOWN = {"reconstruction": 0.01, "offline": 0.05, "once": 0.03, "full": 0.02}
GUESSES = {"repeat-last": 0.5, "mean-frame": 0.4, "previous-frame": 0.2}


def errors(level: float, visible: float = 0.0) -> Errors:
    """The first channel errs by half of `level`, the second by one and a half, before the fit's
    end both by 0.01."""
    absolute = np.full((COUNT, LENGTH, 2), 0.01)
    absolute[:, FIT_FRAMES:] = 0.5 * level, 1.5 * level
    return Errors(absolute, np.full((COUNT, LENGTH), visible))


def judged(name: str, reynolds: float = TRAINED, **levels: float) -> Judged:
    """A result in which each method errs as `levels` says; names with underscores."""
    found = cases(WAKES[name], COUNT, () if reynolds == TRAINED else (reynolds,))
    *_, case = found
    known = {**KNOWN, **GUESSES, **{m.replace("_", "-"): level for m, level in levels.items()}}
    card = ModelCard("cylinder", "test", 0.15, training={"command": "koop-train x"})
    strip = np.random.default_rng(0).uniform(0, 1, (2, len(SHOWN), 16, 32))
    found = {method: errors(level) for method, level in known.items()}
    turned = np.linspace(0.1, 0.3, COUNT) * case.wake.actuated
    return Judged(case, card, "0123456789abcdef", UNITS, 0.15, 9.0, found, strip, turned)


def splits(name: str = "cylinder", **levels: float) -> Splits:
    """The trained Reynolds number and 60, where everything errs half as much again."""
    home = judged(name, **levels)
    other = judged(name, 60.0, **levels)
    more = {method: e.on(lambda x: 1.5 * x) for method, e in other.errors.items()}
    return {
        OVERLAPPING: home,
        APART: home.apart(),
        "reynolds-60": dataclasses.replace(other, errors=more),
    }


def changed(splits: Splits, method: str, found: Errors) -> Splits:
    """Other errors of one method on the overlapping sequences."""
    home = splits[OVERLAPPING]
    kept = {**home.errors, method: found}
    return {**splits, OVERLAPPING: dataclasses.replace(home, errors=kept)}


def growing(level: float, last: float) -> Errors:
    """From `level` at the fit's end evenly to `last` at the end."""
    found = errors(1.0)
    found.absolute[:, FIT_FRAMES:] *= np.linspace(level, last, LENGTH - FIT_FRAMES)[:, None]
    return found
