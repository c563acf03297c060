"""A linear plant that becomes another one: online follows, frozen does not, and it is counted."""

import dataclasses

import numpy as np
import pytest

from koop_service.evaluation.forecasts import roll_out
from koop_service.evaluation.studies import change
from koop_service.evaluation.studies.change import (
    Case,
    frames_to_recover,
    level_before,
    outcome,
    predictions,
)

from ..linear_world import SETTINGS, linear_codes  # noqa: TID252

AT = 110


@pytest.fixture(scope="module")
def predicted():
    """Codes whose Theta is another one from frame AT on, and what is predicted of them."""
    codes, controls, _ = linear_codes(2, 180, seed=1)
    *_, Theta = linear_codes(2, 5, seed=2)
    rest = roll_out(Theta, codes[:, AT - 2 : AT], controls[:, AT - 1 :], SETTINGS)
    codes = np.concatenate([codes[:, :AT], rest], axis=1)
    settings = dataclasses.replace(SETTINGS, forgetting=0.985)
    return codes, predictions(codes, controls, settings, AT)


def error(predicted, method, steps, t):
    codes, found = predicted
    return np.abs(found[method][steps][:, t] - codes[:, t + steps]).max()


def test_before_the_change_everybody_is_right(predicted):
    for method in predicted[1]:
        assert error(predicted, method, 1, AT - 2) < 1e-3
        assert error(predicted, method, 10, AT - 11) < 1e-3


def test_after_it_who_learns_on_is_right_again(predicted):
    assert set(predicted[1]) == {
        *(f"online, forgetting {x}" for x in ("0.95", "0.985", "1")),
        "frozen",
    }
    for steps in change.STEPS:
        quick, slow, frozen = (
            error(predicted, method, steps, AT + 50)
            for method in ("online, forgetting 0.95", "online, forgetting 1", "frozen")
        )
        assert quick < 0.5 * slow < slow < frozen
        assert quick < 0.1 * frozen


def test_where_nothing_is_predicted(predicted):
    codes, found = predicted
    known = ~np.isnan(found["frozen"][1][0, :, 0])
    assert known[60:-10].all()
    assert known.sum() == codes.shape[1] - 70


def stepping(after):
    """An RMSE of 0.1 until frame 150, and after it what is given, then 0.1 to the end."""
    rmse = np.full(320, 0.1)
    rmse[150 : 150 + len(after)] = after
    rmse[310:] = np.nan
    return rmse


def test_frames_to_recover():
    assert level_before(stepping([9.0]), 150) == pytest.approx(0.1)
    assert frames_to_recover(stepping([]), 150) == 0
    assert frames_to_recover(stepping(np.full(30, 0.14)), 150) == 0
    # The running mean is good once the last high value has left it.
    assert frames_to_recover(stepping(np.full(30, 1.0)), 150) == 30
    assert frames_to_recover(stepping(np.full(160, 0.2)), 150) is None
    relapse = np.full(100, 0.1)
    relapse[80:] = 1.0
    assert frames_to_recover(stepping(relapse), 150) == 100


def test_words_and_rows():
    rmse = {"online, forgetting 0.95": {1: stepping([1.0] * 5), 10: stepping([1.0] * 40)}}
    rmse["frozen"] = {k: stepping([1.0] * 160) for k in change.STEPS}
    case = Case("cartpole", "mass", 1.5, 0.985, 20, 0.05, rmse, np.full(320, 0.05))
    result = outcome([case])
    assert result.table["cartpole"]["frozen"] == {"1": None, "10": None}
    assert "| cartpole | online, forgetting 0.95 | 5 | 40 |" in result.text
    assert "| cartpole | frozen | never | never |" in result.text
    assert "mass x 1.5 at 7.5 s" in result.text
    assert len(result.rows) == 4
    assert all(len(row) == len(result.columns) for row in result.rows)
