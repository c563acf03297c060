"""The methods that work on codes: ours and the learned baseline, under the paper's three regimes.

offline is never updated, once a single time, full at every frame. A fit of 32 numbers to 16 frames
has fewer rows than unknowns: the proximal one then takes the smallest Theta that explains them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.fits import Constant, ConstantControl, Proximal
from koop_service.evaluation.fluid.cases import FIT_FRAMES, UPDATE_AT
from koop_service.evaluation.forecasts import Array, Models, Schedule, forecast
from koop_service.evaluation.selection import with_offline_rho
from koop_service.learning.dynamics import LearnedDynamics

REGIMES = ("offline", "once", "full")


@dataclass(frozen=True, eq=False)
class Method:
    """Fits and their roll-outs, one after the other: each holds from its schedule's fit on."""

    name: str
    stages: Sequence[tuple[Models, Schedule]]

    def predict(self, known: Known) -> Array:
        """Codes (N, T, n): measured in the first fit's frames, predicted after them."""
        predicted = known.codes.copy()
        for models, schedule in self.stages:
            after = schedule.fit_frames
            found = forecast(models, schedule, known.codes, known.controls)
            predicted[:, after:] = found[:, after:]
        return predicted


@dataclass(frozen=True, eq=False)
class Known:
    """A model's estimator settings, codes (N, T, n) and controls (N, T-1, p)."""

    settings: EstimatorSettings
    codes: Array
    controls: Array


def ours(known: Known) -> Iterator[Method]:
    """The fit under each regime."""
    for regime, stages in _regimes(Proximal, known).items():
        yield Method(regime, stages)


def theirs(learned: LearnedDynamics, known: Known) -> Iterator[Method]:
    """[17], which no update can change; or [6] under each regime."""
    if learned.kind == "learned-A":
        models = Constant(learned.matrix, known.settings)
        yield Method(learned.kind, [(models, Schedule(FIT_FRAMES))])
        return
    for regime, stages in _regimes(partial(ConstantControl, learned.matrix), known).items():
        yield Method(named(learned.kind, regime), stages)


def named(kind: str, regime: str) -> str:
    """How a baseline under a regime is called."""
    return kind if regime == "offline" else f"{kind}-{regime}"


def _regimes(
    fit: Callable[[EstimatorSettings], Models], known: Known
) -> dict[str, list[tuple[Models, Schedule]]]:
    first, second = (
        (fit(_settled(fit, known, frames)), Schedule(frames)) for frames in (FIT_FRAMES, UPDATE_AT)
    )
    following = fit(known.settings), Schedule(FIT_FRAMES, every=1)
    return dict(zip(REGIMES, ([first], [first, second], [following]), strict=True))


def _settled(
    fit: Callable[[EstimatorSettings], Models], known: Known, frames: int
) -> EstimatorSettings:
    """For a fit to so many frames that then stays.

    It weighs its frames alike, as eq. 3 does, and is rolled out for long; the card's forgetting and
    rho are for following a stream.
    """
    alike = replace(known.settings, forgetting=1.0)
    return with_offline_rho(fit, alike, frames, known.codes, known.controls)
