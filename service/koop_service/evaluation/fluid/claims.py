"""What the paper's section A.3 claims and what a user would hope for, and whether it is so.

A claim in words needs a measure; each check below says which one it takes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from koop_service.evaluation.claims import Finding
from koop_service.evaluation.fluid.assessment import Judged
from koop_service.evaluation.fluid.cases import FIT_FRAMES, UPDATE_AT
from koop_service.evaluation.fluid.methods import REGIMES, named
from koop_service.evaluation.fluid.table import (
    OVERLAPPING,
    Results,
    Splits,
    by_reynolds,
    reached,
)

_STRETCH = 20  # frames whose mean L1 is compared with another stretch's
_STEADY = 1.2
"""An L1 that does not grow is at the end within this factor of that at the beginning."""
_SEEN = 0.01
"""Errors are invisible while fewer of the pixels err visibly."""


@dataclass(frozen=True)
class Claim:
    """A statement about each wake that was judged: by the paper, or a goal of ours."""

    source: Literal["figure 14", "figure 15", "our goal"]
    text: str
    check: Callable[[Splits], Finding | None]


def findings(results: Results) -> Iterator[tuple[str, Claim, Finding]]:
    """(wake, claim, finding) of every claim that can be checked on what was judged."""
    for claim in CLAIMS:
        for wake, splits in results.items():
            finding = claim.check(splits)
            if finding is not None:
                yield wake, claim, finding


def does_not_grow(regime: str, since: int) -> Callable[[Splits], Finding]:
    """Mean L1 of the last 20 frames over that of the 20 from frame `since` on: within 1.2."""

    def check(splits: Splits) -> Finding:
        curve = splits[OVERLAPPING].curve(regime)
        first, last = curve[since : since + _STRETCH].mean(), curve[-_STRETCH:].mean()
        words = f"{first:.4f} in the first {_STRETCH} frames, {last:.4f} in the last {_STRETCH}"
        return Finding(f"{words} ({last / first:.2f} times)", bool(last <= _STEADY * first))

    return check


def below_offline(splits: Splits) -> Finding:
    """Mean L1 from frame 40 on, of one update and of full ones, against offline's: below."""
    judged = splits[OVERLAPPING]
    once, full, offline = (judged.curve(m)[UPDATE_AT:].mean() for m in ("once", "full", "offline"))
    words = f"from frame {UPDATE_AT} on {once:.4f} with one update, {full:.4f} with all, "
    return Finding(f"{words}{offline:.4f} offline", bool(max(once, full) < offline))


def invisible(splits: Splits) -> Finding:
    """Share of visibly wrong pixels at the last frame, median sequence, all regimes: under 1%."""
    judged = splits[OVERLAPPING]
    shares = {m: float(np.median(judged.errors[m].visible[:, -1])) for m in REGIMES}
    still = float(np.median(judged.errors["repeat-last"].visible[:, -1]))
    words = ", ".join(f"{share:.1%} {regime}" for regime, share in shares.items())
    ours = f"pixels that err by over 5% of the colours, {_last(judged)} frames after the fit: "
    return Finding(
        f"{ours}{words} (repeating the last frame: {still:.1%})", max(shares.values()) < _SEEN
    )


def below_learned_b(splits: Splits) -> Finding | None:
    """The learned B's mean L1 over ours, in each regime: above 1."""
    judged = splits[OVERLAPPING]
    if "learned-B" not in judged.errors:
        return None
    ratios = {
        regime: judged.after_fit(named("learned-B", regime)) / judged.after_fit(regime)
        for regime in REGIMES
    }
    words = ", ".join(f"{ratio:.2f} {regime}" for regime, ratio in ratios.items())
    return Finding(f"learned B over ours: {words}", min(ratios.values()) > 1)


def below_guesses(method: str, guesses: Sequence[str]) -> Callable[[Splits], Finding]:
    """The best guess's L1 over the method's at each horizon: above 1."""

    def check(splits: Splits) -> Finding:
        judged = splits[OVERLAPPING]
        known = [guess for guess in guesses if guess in judged.errors]
        points = []
        for k in reached(judged):
            frame = FIT_FRAMES - 1 + k
            best = min(judged.curve(guess)[frame] for guess in known)
            points.append((k, float(best / judged.curve(method)[frame])))
        words = ", ".join(f"{ratio:.1f} at {k * judged.dt:g} s" for k, ratio in points)
        holds = min(ratio for _, ratio in points) > 1
        return Finding(f"the best of {' and '.join(known)} over {method}: {words}", holds)

    return check


def transfers(regime: str, factor: float = 2.0) -> Callable[[Splits], Finding | None]:
    """Mean L1 at each Reynolds number not trained on over that at the trained one: `factor`."""

    def check(splits: Splits) -> Finding | None:
        found = {judged.case.reynolds: judged.after_fit(regime) for judged in by_reynolds(splits)}
        at_home = next(j.case.reynolds for j in by_reynolds(splits) if not j.case.held_out)
        ratios = {re: l1 / found[at_home] for re, l1 in found.items() if re != at_home}
        if not ratios:
            return None
        words = ", ".join(f"{ratio:.2f} at Re {re:g}" for re, ratio in ratios.items())
        ours = f"{regime}, over the {found[at_home]:.4f} at Re {at_home:g}: {words}"
        return Finding(ours, max(ratios.values()) <= factor)

    return check


def _last(judged: Judged) -> int:
    return len(judged.curve("offline")) - FIT_FRAMES


CLAIMS = (
    Claim("figure 14", "One update keeps the L1 from growing.", does_not_grow("once", UPDATE_AT)),
    Claim("figure 14", "Full updates keep the L1 from growing.", does_not_grow("full", FIT_FRAMES)),
    Claim("figure 14", "Updates lower the L1.", below_offline),
    Claim("figure 14", "Fitting B beats the learned B of [6].", below_learned_b),
    Claim("figure 15", "Errors are invisible to the naked eye after 15 s.", invisible),
    Claim(
        "our goal",
        "Without updates, better than any guess from the fit frames at all horizons.",
        below_guesses("offline", ("repeat-last", "mean-frame", "repeat-period")),
    ),
    Claim(
        "our goal",
        "With full updates, better than any guess from the frames before.",
        below_guesses("full", ("previous-frame", "period-ago")),
    ),
    Claim(
        "our goal",
        "Without updates, at most twice the L1 at a Reynolds number not trained on.",
        transfers("offline"),
    ),
    Claim(
        "our goal",
        "With full updates, at most twice the L1 at a Reynolds number not trained on.",
        transfers("full"),
    ),
)
