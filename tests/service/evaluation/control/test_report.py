"""What is told of many drives: rates, costs, ratios, and the change of mass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from koop_service.evaluation.control import report
from koop_service.evaluation.control.methods import METHODS, REFERENCE
from koop_service.evaluation.control.plants import PLANTS, chosen
from koop_service.evaluation.control.study import Change, OpenLoop
from koop_service.evaluation.control.trials import Protocol, Trials

PLANT = PLANTS["cartpole-actuated"]
DT = 0.05


def trials(success: list[bool], cost: list[float], angle: float = 0.0) -> Trials:
    shape = (len(success), 160)
    picture = np.zeros((3, 64, 64), np.uint8)
    angles = np.full(shape, angle)
    return Trials(
        np.array(success),
        np.array(cost),
        angles,
        np.zeros(shape),
        np.zeros(shape),
        0.002,
        0.009,
        0,
        picture,
        picture[:0],
    )


def judged() -> report.Judged:
    found = {name: trials([True, True], [3.0, 5.0]) for name in METHODS}
    found["mpc"] = trials([True, False], [6.0, 50.0])
    found["learned-B"] = trials([False, False], [np.nan, np.nan])
    found[REFERENCE] = trials([True, True], [4.0, 5.0])
    runs = {"online": trials([True], [1.0], 0.02), "frozen": trials([True], [1.0], -0.2)}
    blind = OpenLoop(
        np.array([0.1, 0.3]), np.zeros((10, 64, 64), np.uint8), np.zeros((10, 64, 64), np.uint8),
        np.zeros(11), np.zeros(10),
    )  # fmt: skip
    return report.Judged(PLANT, DT, found, Change(PLANT, 3.0, 1.5, runs), blind)


def test_the_cost_ratio_counts_the_starts_on_which_the_method_succeeded() -> None:
    one = judged()
    assert one.ratio("mpc") == pytest.approx(6.0 / 4.0)
    assert one.ratio(REFERENCE) == 1.0
    assert np.isnan(one.ratio("learned-B"))


def test_the_json_has_rates_costs_and_latencies_and_no_nan() -> None:
    found = report.as_json([judged()])["cartpole-actuated"]
    assert found["mpc"] == {
        "success_rate": 0.5, "cost": 28.0, "cost_ratio": 1.5, "p99": 0.009,
    }  # fmt: skip
    assert found["learned-B"]["cost"] is None
    assert found["open-loop"]["arrival_error"] == pytest.approx(0.2)
    assert found["change-of-mass"] == pytest.approx({"online": 0.02, "frozen": 0.2})


def test_the_page_says_it_in_words() -> None:
    page = report.markdown([judged()], Protocol(2, 2), "koop-eval control --starts 2")
    assert (
        "| ours, receding horizon (eq. 13) | 1 of 2 | 28.00 | 1.50 | 2.0 ms | 9.0 ms | 0 |" in page
    )
    assert "| PD, true state | 2 of 2 | 4.00 | 0.89 |  |  | 0 |" in page
    assert "10.0 times as much" in page
    assert "Figure 6" in page


def test_starts_are_run_in_batches_that_cover_all() -> None:
    assert Protocol(45, 20).batches() == [(0, 20), (20, 20), (40, 5)]
    assert replace(Protocol(), starts=1).batches() == [(0, 1)]


def test_plants_are_chosen_by_either_name() -> None:
    assert chosen(()) == list(PLANTS.values()) == chosen(("all",))
    assert chosen(("cartpole",)) == [PLANT] == chosen(("cartpole-actuated",))
    with pytest.raises(ValueError, match=r"double-pendulum.*cannot be controlled"):
        chosen(("double-pendulum",))
