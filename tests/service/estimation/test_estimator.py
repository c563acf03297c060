"""The bank: lanes come and go, learn apart from each other, and survive a snapshot."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from koop_service.estimation import interleaved
from koop_service.estimation.estimator import Bank, Snapshot, warm_up
from koop_service.estimation.innovation import RECENT
from koop_service.estimation.settings import EstimatorSettings

SIZES = EstimatorSettings(3, 2, 1)


def drawn(rng: np.random.Generator, B: int) -> tuple[np.ndarray, np.ndarray]:
    return rng.standard_normal((B, 7)), rng.standard_normal((B, 3))


def taught(sizes: EstimatorSettings, steps: int, seed: int = 0) -> tuple[Bank, int]:
    bank = Bank(sizes)
    lane = bank.open()
    bank.fold(np.full(steps, lane), *drawn(np.random.default_rng(seed), steps))
    return bank, lane


def test_a_lane_becomes_ready_after_the_warmup() -> None:
    bank, lane = taught(SIZES, SIZES.warmup_updates - 1)
    assert not bank.ready(lane)
    assert not bank.status(lane).ready
    bank.fold(np.array([lane, lane]), *drawn(np.random.default_rng(1), 2))
    status = bank.status(lane)
    assert bank.ready(lane)
    assert status.ready
    assert status.updates == SIZES.warmup_updates + 1
    assert status.residual_rms > 0.0
    assert status.excitation > 1.0


def test_a_closed_lane_is_reused_and_remembers_nothing() -> None:
    bank, lane = taught(SIZES, 40)
    bank.close(lane)
    assert len(bank) == 0
    assert bank.open() == lane
    assert bank.updates(lane) == 0
    assert not bank.theta(lane).any()
    assert not bank.covariance(lane).any()
    assert bank.status(lane).excitation == pytest.approx(1.0)


def test_lanes_are_added_when_all_are_taken() -> None:
    bank, first = taught(SIZES, 40)
    Theta, S = bank.theta(first), bank.covariance(first)
    lanes = [first] + [bank.open() for _ in range(199)]
    assert len(set(lanes)) == len(bank) == 200
    assert np.array_equal(bank.theta(first), Theta)
    assert np.array_equal(bank.covariance(first), S)
    bank.fold(np.array(lanes), *drawn(np.random.default_rng(2), 200))
    assert bank.updates(lanes[-1]) == 1


def test_a_lane_that_is_not_open_is_refused_and_nothing_is_folded() -> None:
    bank, lane = taught(SIZES, 5)
    with pytest.raises(ValueError, match="lane 7 is not open"):
        bank.fold(np.array([lane, 7]), *drawn(np.random.default_rng(0), 2))
    assert bank.updates(lane) == 5
    asked = (bank.theta, bank.factor, bank.status, bank.innovations)
    for refused in (*asked, bank.close, bank.snapshot, bank.reset):
        with pytest.raises(ValueError, match="not open"):
            refused(7)


def test_a_refused_measurement_leaves_the_statistics_alone() -> None:
    bank, lane = taught(SIZES, 5)
    with pytest.raises(ValueError, match="not finite"):
        bank.fold(np.array([lane]), np.full((1, 7), np.nan), np.zeros((1, 3)))
    assert bank.updates(lane) == 5


@pytest.mark.parametrize("memory", [{}, {"forgetting": 0.95}, {"window": 8, "forgetting": 0.95}])
def test_a_restored_lane_goes_on_with_the_same_bits(memory: dict[str, float]) -> None:
    sizes = replace(SIZES, **memory)  # pyright: ignore[reportArgumentType]
    bank, lane = taught(sizes, 45)
    other = Bank(sizes)
    other.open()
    copy = other.open()
    other.restore(copy, bank.snapshot(lane))
    W, Y = drawn(np.random.default_rng(3), 30)
    bank.fold(np.full(30, lane), W, Y)
    other.fold(np.full(30, copy), W, Y)
    assert same(bank.snapshot(lane), other.snapshot(copy))
    assert bank.theta(lane).tobytes() == other.theta(copy).tobytes()
    assert bank.innovations(lane).shape == (RECENT, 3)
    assert bank.innovations(lane).tobytes() == other.innovations(copy).tobytes()


def same(one: Snapshot, two: Snapshot) -> bool:
    """Equal in every bit."""
    return one.keys() == two.keys() and all(
        np.asarray(one[name]).tobytes() == np.asarray(two[name]).tobytes() for name in one
    )


def test_a_snapshot_does_not_change_with_the_lane() -> None:
    bank, lane = taught(SIZES, 20)
    snapshot = bank.snapshot(lane)
    before = {name: np.array(value) for name, value in snapshot.items()}
    bank.fold(np.array([lane]), *drawn(np.random.default_rng(4), 1))
    assert all(np.array_equal(snapshot[name], before[name]) for name in snapshot)


def test_a_snapshot_that_does_not_fit_is_refused_and_changes_nothing() -> None:
    bank, lane = taught(SIZES, 20)
    before = bank.snapshot(lane)
    foreign, theirs = taught(replace(SIZES, window=5), 20)
    wrong = [
        foreign.snapshot(theirs),
        {name: value for name, value in before.items() if name != "covariance"},
        {**before, "covariance": np.zeros((2, 2))},
        {**before, "rows": np.full_like(before["rows"], np.nan)},
        {**before, "steps": -1},
    ]
    for snapshot in wrong:
        with pytest.raises(ValueError, match="expected"):
            bank.restore(lane, snapshot)
    assert same(bank.snapshot(lane), before)


def test_a_lane_needs_less_than_20_kilobytes() -> None:
    tracemalloc.start()
    bank = Bank(EstimatorSettings(8, 2, 1, forgetting=0.99), 1024)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert bank.open() == 0
    assert 2_000 * 1024 < held < 20_000 * 1024


def test_warm_up_compiles_every_kernel() -> None:
    warm_up(SIZES)
    assert interleaved.fold_all.signatures  # pyright: ignore[reportFunctionMemberAccess]
