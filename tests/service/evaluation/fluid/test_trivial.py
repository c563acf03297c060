"""Guesses know what they may know, and a flow that comes back is guessed exactly."""

from __future__ import annotations

import numpy as np
import pytest

from koop_service.evaluation.fluid.trivial import guesses, period_lag

from .waves import PERIOD, waves

FIT = 16
FRAMES = waves(60)


def found(frames: np.ndarray) -> dict[str, np.ndarray]:
    shape = (len(frames) - FIT, *frames.shape[1:])
    return {name: np.broadcast_to(g, shape) for name, g in guesses(frames, FIT, periodic=True)}


def test_each_guess_is_what_it_is_called() -> None:
    guess = found(FRAMES)
    np.testing.assert_array_equal(guess["repeat-last"], [FRAMES[FIT - 1]] * 44)
    np.testing.assert_allclose(guess["mean-frame"][7], FRAMES[:FIT].mean(0, dtype=float), atol=1e-3)
    np.testing.assert_array_equal(guess["previous-frame"], FRAMES[FIT - 1 : -1])
    np.testing.assert_array_equal(guess["period-ago"], FRAMES[FIT - PERIOD : -PERIOD])


def test_a_periodic_flow_is_guessed_exactly() -> None:
    guess = found(FRAMES)
    for name in ("repeat-period", "period-ago"):
        np.testing.assert_allclose(guess[name], FRAMES[FIT:], atol=2e-3)
    assert np.abs(guess["repeat-last"] - FRAMES[FIT:]).max() > 1


@pytest.mark.parametrize("period", range(4, 13))
def test_the_lag_is_the_period(period: int) -> None:
    assert period_lag(waves(FIT, period=period)) % period == 0


def test_nothing_is_known_before_its_time() -> None:
    """Frames from 30 on differ; guesses of frames up to 30 know none of them."""
    other = FRAMES.copy()
    other[30:] += 1
    before, after = found(FRAMES), found(other)
    for name in ("repeat-last", "mean-frame", "repeat-period"):
        np.testing.assert_array_equal(before[name], after[name])
    for name in ("previous-frame", "period-ago"):
        np.testing.assert_array_equal(before[name][: 31 - FIT], after[name][: 31 - FIT])
        assert not np.array_equal(before[name], after[name])


def test_without_a_period_of_its_own_there_are_no_periodic_guesses() -> None:
    names = [name for name, _ in guesses(FRAMES, FIT, periodic=False)]
    assert names == ["repeat-last", "mean-frame", "previous-frame"]
