"""The methods that work on codes: ours and the learned baseline, under the paper's three regimes.

offline is never updated, once a single time, full at every frame. A fit of 32 numbers to 16 frames
has fewer rows than unknowns: the proximal one then takes the smallest Theta that explains them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.fits import Constant, ConstantControl, Proximal
from koop_service.evaluation.fluid.cases import FIT_FRAMES, UPDATE_AT
from koop_service.evaluation.forecasts import Array, Models, Schedule
from koop_service.evaluation.selection import with_offline_rho
from koop_service.learning.dynamics import LearnedDynamics

REGIMES = {
    "offline": Schedule(FIT_FRAMES),
    "once": Schedule(FIT_FRAMES, once=UPDATE_AT),
    "full": Schedule(FIT_FRAMES, every=1),
}


@dataclass(frozen=True, eq=False)
class Method:
    """Where a method's models come from, and when it is updated."""

    name: str
    models: Models
    schedule: Schedule


@dataclass(frozen=True, eq=False)
class Known:
    """A model's estimator settings, codes (N, T, n) and controls (N, T-1, p)."""

    settings: EstimatorSettings
    codes: Array
    controls: Array


def ours(known: Known) -> Iterator[Method]:
    """The fit under each regime."""
    for regime, models, schedule in _regimes(Proximal, known):
        yield Method(regime, models, schedule)


def theirs(learned: LearnedDynamics, known: Known) -> Iterator[Method]:
    """[17], which no update can change; or [6] under each regime."""
    if learned.kind == "learned-A":
        models = Constant(learned.matrix, known.settings)
        yield Method(learned.kind, models, REGIMES["offline"])
        return
    for regime, models, schedule in _regimes(partial(ConstantControl, learned.matrix), known):
        yield Method(named(learned.kind, regime), models, schedule)


def named(kind: str, regime: str) -> str:
    """How a baseline under a regime is called."""
    return kind if regime == "offline" else f"{kind}-{regime}"


def _regimes(
    fit: Callable[[EstimatorSettings], Models], known: Known
) -> Iterator[tuple[str, Models, Schedule]]:
    # A fit to a stretch that is all known weighs its frames alike, as eq. 3 does, and is rolled out
    # for long; the card's forgetting and rho are for following a stream.
    alike = replace(known.settings, forgetting=1.0)
    settled = with_offline_rho(fit, alike, FIT_FRAMES, known.codes, known.controls)
    for regime, schedule in REGIMES.items():
        yield regime, fit(known.settings if regime == "full" else settled), schedule
