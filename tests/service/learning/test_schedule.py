"""Rates, horizons and step counts as functions of the step."""

import dataclasses

import numpy as np
import pytest

from koop_service.learning.presets import PRESETS, REGIMES, RollOut, Stage, with_regime
from koop_service.learning.schedule import (
    drawn_horizon,
    growing_horizon,
    learning_rate,
    mean_horizon,
)

from .blobs import smoke


def test_the_horizon_grows_from_one_to_its_end():
    preset, roll = smoke(steps=100), RollOut(fit_frames=(4, 8), horizon=20, rho=1e-3)
    horizons = [growing_horizon(step, preset, roll) for step in range(100)]
    assert (horizons[0], horizons[-1]) == (1, 20)
    assert horizons == sorted(horizons)


def test_a_mixture_draws_horizons_of_each_octave_alike():
    roll, rng = (
        RollOut(fit_frames=(4, 8), horizon=64, rho=1e-3, shortest=8),
        np.random.default_rng(0),
    )
    drawn = np.array([drawn_horizon(64, roll, rng) for _ in range(3000)])
    assert (drawn.min(), drawn.max()) == (8, 64)
    assert [np.mean((drawn >= k) & (drawn < 2 * k)) for k in (8, 16, 32)] == pytest.approx(
        [1 / 3] * 3, abs=0.03
    )
    assert drawn.mean() == pytest.approx(mean_horizon(64, roll), rel=0.03)


def test_without_a_mixture_every_batch_has_the_longest_horizon():
    roll, rng = RollOut(fit_frames=(4, 8), horizon=64, rho=1e-3), np.random.default_rng(0)
    assert drawn_horizon(5, roll, rng) == mean_horizon(5, roll) == 5
    short = dataclasses.replace(roll, shortest=8)
    assert drawn_horizon(5, short, rng) == mean_horizon(5, short) == 5


def test_a_cosine_falls_to_a_hundredth():
    stage = Stage(100, batch=1, rate=2e-3, clip=1.0)
    rates = [learning_rate(stage, step) for step in range(100)]
    assert rates == sorted(rates, reverse=True)
    assert rates[0] == 2e-3
    assert rates[-1] == pytest.approx(2e-5, rel=0.1)


def test_the_papers_rate_is_halved_every_twenty_of_two_hundred_epochs():
    stage = PRESETS["paper"].dynamics.on(4000)
    assert stage.steps == 200 * 4000 // 16
    epoch = 4000 // 16
    assert learning_rate(stage, 20 * epoch - 1) == 1e-3
    assert learning_rate(stage, 20 * epoch) == 5e-4
    assert learning_rate(stage, 199 * epoch) == pytest.approx(1e-3 / 2**9)


@pytest.mark.parametrize("regime", REGIMES)
def test_regimes_predict_as_many_frames_each(regime):
    roll = with_regime(PRESETS["cpu"], regime).free
    assert roll.after(roll.horizon) == roll.restarts * roll.horizon == 90


def test_a_window_holds_the_fit_and_all_that_is_predicted():
    several = RollOut(fit_frames=(40, 60), horizon=15, rho=1e-3, restarts=4, beyond=20)
    assert several.longest == 80
    assert dataclasses.replace(several, refit=True).longest == 120
