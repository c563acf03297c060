"""Each claim holds where it should, fails where it should, and says the numbers."""

from __future__ import annotations

import pytest

from koop_service.evaluation.fluid import claims
from koop_service.evaluation.fluid.cases import FIT_FRAMES, UPDATE_AT
from koop_service.evaluation.fluid.methods import REGIMES

from .made_up import changed, errors, growing, splits


@pytest.mark.parametrize(("regime", "since"), [("once", UPDATE_AT), ("full", FIT_FRAMES)])
def test_growth(regime: str, since: int) -> None:
    check = claims.does_not_grow(regime, since)
    assert check(splits()).holds
    assert not check(changed(splits(), regime, growing(0.02, 0.04))).holds
    assert check(changed(splits(), regime, growing(0.04, 0.02))).holds


def test_what_came_before_the_update_does_not_count() -> None:
    found = errors(0.03)
    found.absolute[:, FIT_FRAMES:UPDATE_AT] = 0.001
    assert claims.does_not_grow("once", UPDATE_AT)(changed(splits(), "once", found)).holds
    assert not claims.does_not_grow("once", FIT_FRAMES)(changed(splits(), "once", found)).holds


def test_updates_lower_the_error() -> None:
    found = claims.below_offline(splits())
    assert found.holds
    assert "0.0300 with one update, 0.0200 with all, 0.0500 offline" in found.ours
    assert not claims.below_offline(splits(once=0.06)).holds
    assert not claims.below_offline(splits(full=0.06)).holds


def test_the_learned_b() -> None:
    levels = {"learned_B": 0.1, "learned_B_once": 0.09, "learned_B_full": 0.03}
    found = claims.below_learned_b(splits("cylinder-actuated", **levels))
    assert found is not None
    assert found.holds
    assert found.ours == "learned B over ours: 2.00 offline, 3.00 once, 1.50 full"
    worse = claims.below_learned_b(
        splits("cylinder-actuated", **{**levels, "learned_B_full": 0.01})
    )
    assert worse is not None
    assert not worse.holds
    assert claims.below_learned_b(splits()) is None


@pytest.mark.parametrize("regime", REGIMES)
def test_one_visible_regime_is_enough(regime: str) -> None:
    assert claims.invisible(splits()).holds
    assert claims.invisible(changed(splits(), regime, errors(0.1, visible=0.009))).holds
    found = claims.invisible(changed(splits(), regime, errors(0.1, visible=0.011)))
    assert not found.holds
    assert f"1.1% {regime}" in found.ours


def test_guesses() -> None:
    check = claims.below_guesses("offline", ("repeat-last", "mean-frame", "repeat-period"))
    assert check(splits()).holds
    assert (
        "the best of repeat-last and mean-frame over offline: 8.0 at 0.15 s" in check(splits()).ours
    )
    assert not check(splits(repeat_period=0.04)).holds
    crossing = changed(splits(), "offline", growing(0.02, 0.6))
    assert not check(crossing).holds


def test_other_reynolds_numbers() -> None:
    check = claims.transfers("full")
    found = check(splits())
    assert found is not None
    assert found.holds
    assert found.ours == "full, over the 0.0200 at Re 50: 1.50 at Re 60"
    home_alone = {name: judged for name, judged in splits().items() if not judged.case.held_out}
    assert check(home_alone) is None
    assert not claims.transfers("full", 1.4)(splits()).holds
    better = changed(splits(full=0.02), "full", errors(0.001))
    assert check(better) == found  # overlapping sequences are not what is compared


def test_every_claim_that_can_be_checked() -> None:
    levels = {"learned_B": 1.0, "learned_B_once": 1.0, "learned_B_full": 1.0}
    results = {"cylinder": splits(), "cylinder-actuated": splits("cylinder-actuated", **levels)}
    found = list(claims.findings(results))
    assert len(found) == 2 * len(claims.CLAIMS) - 1  # the natural wake has no B
    assert all(finding.holds for _, _, finding in found)
