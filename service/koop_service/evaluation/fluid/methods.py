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
from koop_service.evaluation.forecasts import Models, Schedule
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


def ours(settings: EstimatorSettings) -> Iterator[Method]:
    """The fit under each regime."""
    for regime, models, schedule in _regimes(Proximal, settings):
        yield Method(regime, models, schedule)


def theirs(learned: LearnedDynamics, settings: EstimatorSettings) -> Iterator[Method]:
    """[17], which no update can change; or [6] under each regime."""
    if learned.kind == "learned-A":
        yield Method(learned.kind, Constant(learned.matrix, settings), REGIMES["offline"])
        return
    for regime, models, schedule in _regimes(partial(ConstantControl, learned.matrix), settings):
        yield Method(named(learned.kind, regime), models, schedule)


def named(kind: str, regime: str) -> str:
    """How a baseline under a regime is called."""
    return kind if regime == "offline" else f"{kind}-{regime}"


def _regimes(
    fit: Callable[[EstimatorSettings], Models], settings: EstimatorSettings
) -> Iterator[tuple[str, Models, Schedule]]:
    # A fit to a stretch that is all known weighs its frames alike, as eq. 3 does; the card's
    # forgetting is for following a stream.
    alike = fit(replace(settings, forgetting=1.0))
    for regime, schedule in REGIMES.items():
        yield regime, fit(settings) if regime == "full" else alike, schedule
