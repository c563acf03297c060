"""Schedules are pure, bounded and rich; the controller is what it says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koop_clients.flow.forcing import feedback, law, schedule
from koop_clients.flow.settings import MAX_ROTATION, FlowSettings


def series(seed: int, frames: int) -> np.ndarray:
    turn = schedule((seed, 0))
    return np.array([turn(number, 0.0) for number in range(frames)])


def test_a_schedule_depends_on_seed_and_number_alone() -> None:
    ordered = series(3, 300)
    turn = schedule((3, 0))
    shuffled = np.random.default_rng(0).permutation(300)
    assert all(turn(int(n), 0.7) == ordered[n] for n in shuffled)
    assert not np.array_equal(ordered, series(4, 300))
    other = schedule((3, 1))
    assert any(other(n, 0.0) != ordered[n] for n in range(64, 128))


@given(st.integers(0, 10**9), st.integers(0, 10**6), st.floats(-5, 5))
def test_no_law_turns_faster_than_allowed(seed: int, number: int, probe: float) -> None:
    for regime in ("rest", "chirp", "sweeps", "schedule", "feedback", "mix"):
        assert abs(law(regime, (seed, 0))(number, probe)) <= MAX_ROTATION


def test_a_schedule_is_rich() -> None:
    turned = series(0, 5000)
    assert 0.9 * MAX_ROTATION < np.abs(turned).max() <= MAX_ROTATION
    assert 0.02 < np.mean(turned == 0) < 0.25
    power = np.abs(np.fft.rfft(turned)) ** 2
    bands = [band.mean() for band in np.array_split(power[: len(power) // 2], 5)]  # to 0.25/frame
    assert min(bands) > 0.05 * max(bands)


def test_the_chirp_is_that_of_morton_et_al() -> None:
    turn = law("chirp", (7, 0))
    frame = FlowSettings().frame_time / 0.23664  # in their units of time
    turned = np.array([turn(number, 0.3) for number in range(5000)])
    assert 0.99 * MAX_ROTATION < np.abs(turned).max() <= MAX_ROTATION
    paused = np.arange(5000) * frame % 1000 > 900
    assert not turned[paused].any()
    assert np.mean(turned[~paused] == 0) < 0.01
    for number in (1000, 4000):  # cycles a frame, which grow with time
        piece = turned[number - 32 : number + 32] - turned[number - 32 : number + 32].mean()
        padded = np.abs(np.fft.rfft(piece * np.hanning(64), 4096))
        assert padded.argmax() / 4096 == pytest.approx(2 * number * frame**2 / 500_000, rel=0.05)


def test_sweeps_are_slow_and_of_many_frequencies_and_amplitudes() -> None:
    turn = law("sweeps", (5, 1))
    pieces = np.array([turn(number, 0.3) for number in range(5120)]).reshape(20, 256)
    assert not pieces[:, -28:].any()
    amplitudes = np.abs(pieces).max(1)
    assert 4 <= (amplitudes > 0.99 * MAX_ROTATION).sum() <= 16
    assert amplitudes.min() < 0.8 * MAX_ROTATION
    halves = [
        np.abs(np.fft.rfft(part, 2048, axis=1)) for part in (pieces[:, :114], pieces[:, 114:228])
    ]
    first, second = (half.argmax(1) / 2048 for half in halves)
    assert np.abs(first - second).max() < 0.025
    assert np.histogram(first, 5, (0, 0.26))[0].min() >= 1
    assert not np.array_equal(pieces[0], [law("sweeps", (5, 0))(k, 0.3) for k in range(256)])


def test_the_reference_controller_is_proportional_and_bounded() -> None:
    turn = feedback()
    assert turn(0, 0.25) == pytest.approx(0.2)
    assert turn(9, -0.25) == pytest.approx(-0.2)
    assert turn(0, 9.0) == MAX_ROTATION
    assert feedback(bound=0.1)(0, -0.25) == -0.1


def test_a_mix_takes_schedule_and_feedback_in_turn() -> None:
    mixed, scheduled = law("mix", (5, 0)), schedule((5, 0))
    for number in (0, 255, 512):
        assert mixed(number, 0.1) == scheduled(number, 0.1)
    for number in (256, 400, 511):
        assert mixed(number, 0.1) == pytest.approx(0.08 + 0.15 * scheduled(number, 0.1))
