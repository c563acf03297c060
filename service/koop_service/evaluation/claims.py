"""What the paper claims in its sections 3.2, 3.3 and A.2.2, and whether our numbers bear it out.

A claim in words needs a measure; each check below says which one it takes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from koop_service.evaluation.assessment import ANGLE_HORIZON, Result
from koop_service.evaluation.residual import TrainingLog
from koop_service.evaluation.systems import HORIZONS
from koop_service.evaluation.table import Results

_CLOSE = 1.2
"""Full updates are as good as the autoencoder allows within this factor."""
_ANGLE = np.deg2rad(5.0)
_ANGLE_SHARE = 0.9


@dataclass(frozen=True)
class Finding:
    """Our numbers in words, and whether they say what the claim says."""

    ours: str
    holds: bool


@dataclass(frozen=True)
class Claim:
    """A statement about one system: by the paper, with the figure it belongs to, or our goal."""

    source: Literal["paper", "goal"]
    figure: int
    system: str
    text: str
    check: Callable[[Result], Finding | None]


def findings(results: Results) -> Iterator[tuple[Claim, Finding]]:
    """Every claim that can be checked on what was judged."""
    for claim in CLAIMS:
        if claim.system in results:
            finding = claim.check(results[claim.system])
            if finding is not None:
                yield claim, finding


def grows(result: Result) -> Finding:
    """Offline error at the last horizon over that at the first: above 1."""
    curve, reached = result.rmse("offline"), _reached(result)
    first, last = (curve[frame] for frame in (reached[0][1], reached[-1][1]))
    ours = f"offline RMSE {first:.3f} after {_span(reached[0])}, {last:.3f} after "
    return Finding(f"{ours}{_span(reached[-1])}", bool(last > first))


def ordered(result: Result) -> Finding:
    """Full below partial below offline at every horizon after the first frame."""
    curves = [result.rmse(method) for method in ("full", "partial", "offline")]
    points = [(spot, [curve[spot[1]] for curve in curves]) for spot in _reached(result)[1:]]
    words = "; ".join(f"{_span(s)}: {_join(values, ' / ')}" for s, values in points)
    holds = all(full < partly < never for _, (full, partly, never) in points)
    return Finding(f"full / partial / offline at {words}", holds)


def as_good_as_the_autoencoder(result: Result) -> Finding:
    """Full updates over reconstruction in each third of the time after the fit: within 1.2."""
    after = slice(result.system.fit_frames, None)
    full, own = (result.rmse(method)[after] for method in ("full", "reconstruction"))
    ratios = [
        float(np.sqrt(np.square(ours).mean() / np.square(theirs).mean()))
        for ours, theirs in zip(np.array_split(full, 3), np.array_split(own, 3), strict=True)
    ]
    words = f"{_join(ratios, ', ', 2)} times the reconstruction RMSE in the three thirds"
    return Finding(f"one step ahead {words}", max(ratios) <= _CLOSE)


def below(theirs: str, factor: float) -> Callable[[Result], Finding | None]:
    """The other method's error over ours, both offline, at every horizon: above `factor`."""

    def check(result: Result) -> Finding | None:
        if theirs not in result.errors:
            return None
        ratios = [(spot, _ratio(result, theirs, spot[1])) for spot in _reached(result)]
        words = ", ".join(f"{ratio:.2f} at {_span(spot)}" for spot, ratio in ratios)
        holds = all(ratio >= factor for _, ratio in ratios)
        return Finding(f"{theirs} over ours, offline: {words}", holds)

    return check


def fails_from_the_first_frame(result: Result) -> Finding | None:
    """The learned A's error at one step: more than twice ours."""
    if "learned-A" not in result.errors:
        return None
    frame = result.system.fit_frames
    ratio = _ratio(result, "learned-A", frame)
    error = result.rmse("learned-A")[frame]
    still = result.rmse("repeat-last")[frame]
    words = f"learned A {error:.3f} at the first frame, {ratio:.2f} times ours"
    return Finding(f"{words} (repeating the last frame: {still:.3f})", ratio > 2)


def good_then_poor(result: Result) -> Finding | None:
    """The learned A's error over ours: under 2 in the first 8 frames, over 2 at the end."""
    if "learned-A" not in result.errors:
        return None
    first, last = result.system.fit_frames + 7, _reached(result)[-1]
    early, late = (_ratio(result, "learned-A", frame) for frame in (first, last[1]))
    words = f"{early:.2f} times ours after 0.4 s, {late:.2f} times after {_span(last)}"
    return Finding(f"learned A {words}", early < 2 < late)


def no_better_than_the_mean_picture(result: Result) -> Finding | None:
    """The learned B's error 2.5 s after the fit: above the mean picture's."""
    frame = result.frame_at(2.5)
    if "learned-B" not in result.errors or frame is None:
        return None
    theirs, mean, ours = (result.rmse(m)[frame] for m in ("learned-B", "mean-frame", "offline"))
    words = f"after 2.5 s learned B {theirs:.3f}, the mean picture {mean:.3f}"
    return Finding(f"{words} (ours offline {ours:.3f})", bool(theirs > mean))


def under_repeating(horizon: float, limit: float) -> Callable[[Result], Finding | None]:
    """Offline error over that of repeating the last frame at one horizon: under `limit`."""

    def check(result: Result) -> Finding | None:
        frame = result.frame_at(horizon)
        if frame is None:
            return None
        ratio = 1 / _ratio(result, "repeat-last", frame)
        words = f"{ratio:.2f} of the RMSE of repeating the last frame, {horizon:g} s after the fit"
        return Finding(words, ratio < limit)

    return check


def angle_within(result: Result) -> Finding | None:
    """Share of trajectories whose angle is read within 5 degrees of the truth: at least 90%."""
    if "offline" not in result.angles:
        return None
    share = angle_share(result, "offline")
    words = f"{share:.0%} of the trajectories within 5 degrees, {ANGLE_HORIZON:g} s after the fit"
    return Finding(words, share >= _ANGLE_SHARE)


def angle_share(result: Result, method: str) -> float:
    """Share of trajectories whose pole's angle a method predicts within 5 degrees."""
    return float((result.angles[method] < _ANGLE).mean())


def residual_fell(log: TrainingLog) -> Finding:
    """Median residual of the last tenth of the steps over that of the first tenth: under 1."""
    tenth = max(1, len(log.steps) // 10)
    first, last = np.median(log.residual[:tenth]), np.median(log.residual[-tenth:])
    return Finding(f"from {first:.3g} to {last:.3g}", bool(last < first))


Spot = tuple[float, int]
"""A horizon [s] and its frame."""


def _reached(result: Result) -> list[Spot]:
    """The horizons that the test set reaches."""
    spots = [(horizon, result.frame_at(horizon)) for horizon in HORIZONS]
    return [(horizon, frame) for horizon, frame in spots if frame is not None]


def _ratio(result: Result, theirs: str, frame: int) -> float:
    return float(result.rmse(theirs)[frame] / result.rmse("offline")[frame])


def _span(spot: Spot) -> str:
    return f"{spot[0]:g} s"


def _join(values: list[float], between: str, digits: int = 3) -> str:
    return between.join(f"{value:.{digits}f}" for value in values)


_GROWS = "Without updates the error grows with time."
_CONSTANT = "With full updates the error is low and constant over time."
_UPDATES = "Updates help: full below partial below none."
_PERFECT = "With full updates the pictures are visually perfect at all time steps."

CLAIMS = (
    Claim("paper", 2, "cartpole", _UPDATES, ordered),
    Claim("paper", 3, "pendulum-high", _GROWS, grows),
    Claim("paper", 3, "cartpole", _GROWS, grows),
    Claim("paper", 3, "pendulum-high", _CONSTANT, as_good_as_the_autoencoder),
    Claim("paper", 3, "cartpole", _CONSTANT, as_good_as_the_autoencoder),
    Claim(
        "paper",
        4,
        "pendulum-fixed",
        "On one pendulum the fit predicts more accurately than a learned A.",
        below("learned-A", 1.0),
    ),
    Claim(
        "paper",
        4,
        "pendulum-low",
        "On many pendulums the fit predicts more accurately than a learned A.",
        below("learned-A", 1.0),
    ),
    Claim(
        "goal",
        4,
        "pendulum-low",
        "On many pendulums a learned A errs at least twice as much at every horizon.",
        below("learned-A", 2.0),
    ),
    Claim("paper", 5, "pendulum-actuated", _GROWS, grows),
    Claim("paper", 5, "cartpole-actuated", _GROWS, grows),
    Claim("paper", 5, "pendulum-actuated", _UPDATES, ordered),
    Claim("paper", 5, "cartpole-actuated", _UPDATES, ordered),
    Claim("goal", 5, "pendulum-actuated", _CONSTANT, as_good_as_the_autoencoder),
    Claim("goal", 5, "cartpole-actuated", _CONSTANT, as_good_as_the_autoencoder),
    Claim(
        "paper",
        5,
        "pendulum-actuated",
        "Even offline, fitting B beats a learned B.",
        below("learned-B", 1.0),
    ),
    Claim(
        "goal",
        5,
        "cartpole-actuated",
        "Even offline, fitting B beats a learned B.",
        below("learned-B", 1.0),
    ),
    Claim(
        "paper",
        5,
        "cartpole-actuated",
        "A learned B makes no accurate prediction of the cartpole over 2.5 s.",
        no_better_than_the_mean_picture,
    ),
    Claim(
        "paper",
        7,
        "pendulum-low",
        "At low amplitude the model without updates is sufficient.",
        angle_within,
    ),
    Claim(
        "goal",
        7,
        "pendulum-low",
        "Offline, under 0.20 of repeating the last frame at 1 s.",
        under_repeating(1.0, 0.2),
    ),
    Claim(
        "goal",
        7,
        "pendulum-low",
        "Offline, under 0.30 of repeating the last frame at 6 s.",
        under_repeating(6.0, 0.3),
    ),
    Claim(
        "paper",
        8,
        "pendulum-fixed",
        "On one pendulum a learned A is good at short horizons and poor at long ones.",
        good_then_poor,
    ),
    Claim(
        "paper",
        9,
        "pendulum-low",
        "On many pendulums a learned A gets not even the first frame right.",
        fails_from_the_first_frame,
    ),
    Claim("paper", 10, "pendulum-high", _UPDATES, ordered),
    Claim("paper", 10, "pendulum-high", _PERFECT, as_good_as_the_autoencoder),
    Claim("paper", 11, "double-pendulum", _UPDATES, ordered),
    Claim("paper", 11, "double-pendulum", _PERFECT, as_good_as_the_autoencoder),
    Claim("paper", 12, "double-pendulum", _GROWS, grows),
)
