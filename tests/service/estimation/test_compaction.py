"""A bank gives memory back, and nobody's bits change."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.estimation.estimator import Bank
from koop_service.estimation.interleaved import LANES
from koop_service.estimation.settings import EstimatorSettings

SETTINGS = EstimatorSettings(2, 1, 1, affine=False, rho=1.0, forgetting=0.95)


def same(one: dict, other: dict) -> bool:
    return one.keys() == other.keys() and all(
        np.asarray(one[name]).tobytes() == np.asarray(other[name]).tobytes() for name in one
    )


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.integers(0, 30))
def test_lanes_that_move_keep_their_bits(seed: int, opened: int, kept: int) -> None:
    rng = np.random.default_rng(seed)
    bank = Bank(SETTINGS)
    lanes = np.array([bank.open() for _ in range(opened)])
    W, Y = rng.normal(size=(2 * opened, 3)), rng.normal(size=(2 * opened, 2))
    bank.fold(np.tile(lanes, 2), W, Y)
    stay = rng.permutation(lanes)[:kept].tolist()
    before = {lane: bank.snapshot(lane) for lane in stay}
    for lane in set(lanes.tolist()) - set(stay):
        bank.close(lane)
    moved = bank.compact()
    assert moved.keys() <= set(stay)
    now = {lane: moved.get(lane, lane) for lane in stay}
    assert len(set(now.values())) == len(stay) == len(bank)
    assert all(same(before[old], bank.snapshot(new)) for old, new in now.items())
    capacity = len(bank._free) + len(bank)
    assert capacity == LANES or capacity < 4 * len(bank)
    # Those that open next find a lane each, and only the prior in it.
    prior = Bank(SETTINGS)
    empty = prior.snapshot(prior.open())
    fresh = [bank.open() for _ in range(capacity)]
    assert len({*fresh, *now.values()}) == capacity + len(stay)
    assert all(same(bank.snapshot(lane), empty) for lane in fresh)
    assert all(same(before[old], bank.snapshot(new)) for old, new in now.items())
