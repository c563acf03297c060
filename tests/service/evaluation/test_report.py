"""The table and the report say what the results say, and a claim that fails is seen to."""

import csv

import pytest

from koop_service.evaluation import claims
from koop_service.evaluation.report import Report
from koop_service.evaluation.systems import HORIZONS
from koop_service.evaluation.table import as_json, write_csv

from .linear_world import growing, made_up_result


def test_json_is_system_method_horizon_rmse():
    table = as_json({"cartpole": made_up_result("cartpole")})
    assert set(table) == {"cartpole"}
    assert set(table["cartpole"]["offline"]) == {"0.05", "1", "5", "15"}
    assert table["cartpole"]["offline"]["15"] == pytest.approx(0.1)


def test_csv_holds_the_ratio_to_repeating(tmp_path):
    write_csv({"cartpole": made_up_result("cartpole")}, tmp_path / "t.csv")
    with (tmp_path / "t.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6 * len(HORIZONS)
    (row,) = (r for r in rows if (r["method"], r["horizon"]) == ("offline", "5"))
    assert [float(row[c]) for c in ("rmse", "p50", "ratio to repeat-last")] == [0.1, 0.1, 0.5]


def holds(finding: claims.Finding | None) -> bool:
    assert finding is not None
    return finding.holds


def test_updates_in_order():
    assert holds(claims.ordered(made_up_result("cartpole")))
    assert not holds(claims.ordered(made_up_result("cartpole", partial=0.11)))


def test_growth():
    assert holds(claims.grows(growing(made_up_result("cartpole"), "offline", 0.3)))
    assert not holds(claims.grows(growing(made_up_result("cartpole"), "offline", 0.05)))


def test_full_updates_must_stay_near_the_autoencoder():
    result = made_up_result("cartpole", full=0.023)
    assert holds(claims.as_good_as_the_autoencoder(result))
    # Its mean is within 1.2 of the reconstruction, its last third is not.
    assert not holds(claims.as_good_as_the_autoencoder(growing(result, "full", 0.0255)))


def test_baselines():
    result = made_up_result("pendulum-low", learned_A=0.15)
    once = claims.below("learned-A", 1.0)(result)
    assert holds(once)
    assert once is not None
    assert "1.50 at 15 s" in once.ours
    assert not holds(claims.below("learned-A", 2.0)(result))
    assert not holds(claims.fails_from_the_first_frame(result))
    assert not holds(claims.good_then_poor(result))
    assert holds(claims.good_then_poor(growing(result, "learned-A", 0.3)))


def test_without_a_baseline_nothing_is_claimed_of_it():
    result = made_up_result("pendulum-low")
    assert claims.below("learned-A", 1.0)(result) is None
    assert claims.good_then_poor(result) is None
    texts = [claim.text for claim, _ in claims.findings({"pendulum-low": result})]
    assert texts
    assert not any("learned" in text for text in texts)


def test_learned_b_against_the_mean_picture():
    poor, good = (made_up_result("cartpole-actuated", learned_B=x) for x in (0.16, 0.14))
    assert holds(claims.no_better_than_the_mean_picture(poor))
    assert not holds(claims.no_better_than_the_mean_picture(good))


def test_angles_within_five_degrees():
    result = made_up_result("pendulum-low")  # four of five
    assert claims.angle_share(result, "offline") == pytest.approx(0.8)
    assert not holds(claims.angle_within(result))


def test_against_repeating_the_last_frame():
    result = made_up_result("pendulum-low", offline=0.05)  # repeating: 0.2
    assert holds(claims.under_repeating(6.0, 0.3)(result))
    assert not holds(claims.under_repeating(1.0, 0.2)(result))


def test_the_page():
    results = {"pendulum-low": made_up_result("pendulum-low", learned_A=0.15)}
    drawn = {7: ("figure-07.png", "A caption.")}
    page = Report(results, {}, drawn, "koop-eval prediction", ["cartpole skipped"]).markdown()
    assert "![Figure 7](figure-07.png)" in page
    assert "| offline | 0.1000 (0.100 to 0.100) |" in page
    assert "| pendulum-low | offline | 80% | 3.0 |" in page
    assert "**no**" in page
    assert "- cartpole skipped" in page
    held = sum(line.endswith("| yes |") for line in page.splitlines())
    assert f"{held} of {held + page.count('**no**')} hold." in page
