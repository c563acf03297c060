"""The errors told are the brute-force ones, however forecasts overlap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_clients.sim_client.driving.drive import DriveLog
from koop_clients.sim_client.record import Record, Scorebook, stack_series
from koop_clients.sim_client.scoring import Errors, Forecast, Judge, Judged, judge, pool

AHEAD = 4


def film(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, 6, 5), dtype=np.uint8)


def brute_force(seq: int, ahead: int, truth: np.ndarray, predicted: np.ndarray) -> float:
    total = 0.0
    for left, right in zip(truth[seq + ahead].flat, predicted[ahead - 1].flat, strict=True):
        total += ((int(left) - int(right)) / 255) ** 2
    return (total / truth[0].size) ** 0.5


@settings(max_examples=30, deadline=None)
@given(st.sets(st.integers(0, 19)), st.integers(0, 100))
def test_every_forecast_is_compared_with_its_own_frames(asked: set[int], seed: int) -> None:
    truth, guesses = film(20, seed), {seq: film(AHEAD, 1000 + seq) for seq in asked}
    judging, done = Judge(), dict[int, Judged]()
    for seq, frame in enumerate(truth):
        for judged in judging.see(seq, frame):
            done[judged.forecast.seq] = judged
        if seq in asked:
            judging.predict(Forecast(seq, frame, guesses[seq]))
    assert set(done) == {seq for seq in asked if seq + AHEAD < len(truth)}
    for seq, judged in done.items():
        for ahead in range(1, AHEAD + 1):
            expected = brute_force(seq, ahead, truth, guesses[seq])
            assert judged.error[ahead - 1] == pytest.approx(expected)
            still = np.repeat(truth[seq][None], AHEAD, 0)
            assert judged.repeat[ahead - 1] == pytest.approx(brute_force(seq, ahead, truth, still))


def test_a_pool_is_the_root_of_the_mean_square_over_all_pixels() -> None:
    truth = film(12)
    judged = [
        judge(Forecast(seq, truth[seq], film(AHEAD, seq)), truth[seq + 1 : seq + 1 + AHEAD])
        for seq in (1, 4, 7)
    ]
    found = pool(judged, [1, 3])
    assert found is not None
    assert found.horizons == (1, 3)
    assert found.count == 3
    for ahead, error in zip((1, 3), found.error, strict=True):
        squares = [
            (truth[seq + ahead].astype(float) / 255 - film(AHEAD, seq)[ahead - 1] / 255.0) ** 2
            for seq in (1, 4, 7)
        ]
        assert error == pytest.approx(np.sqrt(np.mean(squares)))
    assert pool([], [1]) is None


def test_white_for_black_is_an_error_of_one() -> None:
    black, white = np.zeros((2, 3, 3), np.uint8), np.full((2, 3, 3), 255, np.uint8)
    judged = judge(Forecast(0, white[0], black), white)
    assert judged.error.tolist() == [1.0, 1.0]
    assert judged.repeat.tolist() == [0.0, 0.0]


def test_better_means_better_at_every_horizon() -> None:
    assert Errors((1, 2), (0.1, 0.2), (0.2, 0.3), 1).beats_repeating
    assert not Errors((1, 2), (0.1, 0.3), (0.2, 0.3), 1).beats_repeating


def some(seq: int) -> Judged:
    truth = film(AHEAD, seq)
    return judge(Forecast(seq, truth[0], truth), truth)


def test_a_scorebook_keeps_the_first_and_the_last() -> None:
    book = Scorebook()
    for seq in range(200):
        book.add(some(seq))
    assert [j.forecast.seq for j in book.first] == list(range(20))
    assert [j.forecast.seq for j in book.last] == list(range(150, 200))
    assert [j.forecast.seq for j in book.recent(3)] == [197, 198, 199]


def test_a_short_run_has_only_first_forecasts() -> None:
    book = Scorebook()
    book.add(some(1))
    assert [j.forecast.seq for j in book.recent()] == [1]
    assert not book.last


def test_a_record_survives_the_disk(tmp_path: Path) -> None:
    log = DriveLog(keep_frames=True)
    log.add(film(1)[0], 0.5, 0.1, -2.0)
    series = stack_series([log.series()])
    frames = np.array(log.frames)
    record = Record("cartpole", [some(1), some(5)], [], frames, series, 0.25, 20.0)
    record.save(tmp_path / "run.npz")
    back = Record.load(tmp_path / "run.npz")
    assert (back.system, back.target, back.torque_bound, back.ahead) == ("cartpole", 0.25, 20.0, 4)
    assert [j.forecast.seq for j in back.early] == [1, 5]
    assert back.late == []
    assert np.array_equal(back.early[1].truth, record.early[1].truth)
    assert np.array_equal(back.early[1].error, record.early[1].error)
    assert np.array_equal(back.drive_frames, record.drive_frames)
    assert back.drive_torques.tolist() == [-2.0]
