"""The interleaved batch: equal to the single stream in every bit, whatever comes together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.estimation import factor as single
from koop_service.estimation.factor_batch import FactorBatch
from koop_service.estimation.interleaved import DENSE, LANES
from koop_service.estimation.proximal import solve
from koop_service.estimation.settings import EstimatorSettings

from .strategies import same_bits

SIZES = EstimatorSettings(3, 2, 1)
MEMORIES = [
    SIZES,
    replace(SIZES, forgetting=0.99),
    replace(SIZES, forgetting=0.8),
    replace(SIZES, window=6),
    replace(SIZES, window=6, forgetting=0.9),
]


def drawn(rng: np.random.Generator, B: int) -> tuple[np.ndarray, np.ndarray]:
    """Measurements with zeros of both signs among them."""
    W, Y = rng.standard_normal((B, 7)), rng.standard_normal((B, 3))
    W[rng.random(W.shape) < 0.2] = 0.0
    Y[rng.random(Y.shape) < 0.2] = -0.0
    return W, Y


@pytest.mark.parametrize("sizes", MEMORIES)
@settings(max_examples=15, deadline=None)
@given(
    calls=st.lists(
        st.tuples(st.integers(1, 150), st.sampled_from([3, DENSE, LANES, 2 * LANES])), max_size=12
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_lane_has_the_bits_of_its_own_stream(
    sizes: EstimatorSettings, calls: list[tuple[int, int]], seed: int
) -> None:
    """Few lanes and many, spread over blocks or repeated within a call."""
    rng = np.random.default_rng(seed)
    batch = FactorBatch(sizes, 2 * LANES)
    singles = [single.init(sizes) for _ in range(batch.capacity)]
    for B, among in calls:
        lanes = rng.permutation(batch.capacity)[:among][rng.integers(0, among, B)]
        W, Y = drawn(rng, B)
        E = batch.update(lanes, W, Y)
        for b, lane in enumerate(lanes):
            e = single.update(singles[lane], sizes, W[b], Y[b])
            assert e.tobytes() == E[b].tobytes()
    assert all(same_bits(batch.extract(lane), alone) for lane, alone in enumerate(singles))


@pytest.mark.parametrize("sizes", MEMORIES)
def test_many_steps_in_and_out_of_step_keep_the_bits(sizes: EstimatorSettings) -> None:
    """Whole blocks at once, then lanes at different turns of their refill, over several cycles."""
    rng = np.random.default_rng(0)
    batch, alone = FactorBatch(sizes), single.init(sizes)
    others = np.arange(1, LANES)
    for step in range(120):
        w, y = drawn(rng, 1)
        W, Y = drawn(rng, LANES - 1)
        some = others[rng.random(LANES - 1) < (1.0 if step % 3 else 0.5)]
        lanes = np.concatenate([[0], some])
        batch.update(lanes, np.vstack([w, W[: len(some)]]), np.vstack([y, Y[: len(some)]]))
        single.update(alone, sizes, w[0], y[0])
    assert same_bits(batch.extract(0), alone)


@pytest.mark.parametrize("sizes", MEMORIES)
@pytest.mark.parametrize("active", [1, DENSE, LANES - 1])
def test_lanes_without_a_measurement_keep_their_bits(sizes: EstimatorSettings, active: int) -> None:
    rng = np.random.default_rng(0)
    batch = FactorBatch(sizes)
    for _ in range(20):
        batch.update(np.arange(LANES), *drawn(rng, LANES))
    before = [batch.extract(lane) for lane in range(LANES)]
    for _ in range(20):
        batch.update(np.arange(active), *drawn(rng, active))
    after = [batch.extract(lane) for lane in range(LANES)]
    assert all(same_bits(before[lane], after[lane]) for lane in range(active, LANES))
    assert not any(same_bits(before[lane], after[lane]) for lane in range(active))


def test_an_underflow_to_negative_zero_does_not_flip_when_others_are_updated() -> None:
    """-0.0 in a lane would become 0.0 as soon as the block rotates without it."""
    batch, factor = FactorBatch(SIZES), single.init(SIZES)
    factor.D[0, 0] = -5e-324
    w, y = 1e3 * np.eye(7)[:1], np.full((1, 3), -0.0)
    batch.insert(0, factor)
    batch.update(np.array([0]), w, y)
    single.update(factor, SIZES, w[0], y[0])
    batch.update(np.arange(1, LANES), *drawn(np.random.default_rng(0), LANES - 1))
    assert same_bits(batch.extract(0), factor)


def test_theta_is_the_single_streams() -> None:
    rng = np.random.default_rng(0)
    for sizes in MEMORIES:
        batch = FactorBatch(sizes)
        batch.update(np.repeat(5, 30), *drawn(rng, 30))
        factor = batch.extract(5)
        wanted = solve(factor.R, factor.D, sizes.rho, sizes.solve_iterations)
        assert batch.theta(5).tobytes() == wanted.tobytes()
        assert batch.theta(5).shape == (3, 7)
        assert not batch.theta(4).any()


@pytest.mark.parametrize("sizes", MEMORIES)
def test_extract_insert_and_reset_move_whole_states(sizes: EstimatorSettings) -> None:
    rng = np.random.default_rng(0)
    batch = FactorBatch(sizes, 1)
    batch.update(np.zeros(40, dtype=np.int64), *drawn(rng, 40))
    batch.insert(63, batch.extract(0))
    assert same_bits(batch.extract(63), batch.extract(0))
    W, Y = drawn(rng, 30)
    batch.update(np.repeat([0, 63], 15), np.vstack([W[:15], W[:15]]), np.vstack([Y[:15], Y[:15]]))
    assert same_bits(batch.extract(63), batch.extract(0))
    batch.reset(0)
    assert same_bits(batch.extract(0), single.init(sizes))


def test_growing_keeps_the_lanes_and_adds_empty_ones() -> None:
    rng = np.random.default_rng(0)
    for sizes in MEMORIES:
        batch = FactorBatch(sizes, 1)
        batch.update(np.arange(LANES), *drawn(rng, LANES))
        before = [batch.extract(lane) for lane in range(LANES)]
        batch.grow(LANES + 1)
        assert batch.capacity == 2 * LANES
        assert all(same_bits(batch.extract(lane), old) for lane, old in enumerate(before))
        assert same_bits(batch.extract(LANES), single.init(sizes))


def test_an_empty_batch_is_no_measurement() -> None:
    batch = FactorBatch(SIZES)
    E = batch.update(np.zeros(0, dtype=np.int64), np.zeros((0, 7)), np.zeros((0, 3)))
    assert E.shape == (0, 3)


@pytest.mark.parametrize(
    ("lanes", "W", "Y", "complaint"),
    [
        ([0, 1], np.zeros((1, 7)), np.zeros((2, 3)), r"\(B, 7\) and \(B, 3\)"),
        ([0], np.zeros((1, 8)), np.zeros((1, 3)), r"\(B, 7\) and \(B, 3\)"),
        ([64], np.zeros((1, 7)), np.zeros((1, 3)), "expected 0 to 63"),
        ([-1], np.zeros((1, 7)), np.zeros((1, 3)), "expected 0 to 63"),
        ([0, 9], np.array([[0.0] * 7, [np.nan] * 7]), np.zeros((2, 3)), r"W\[1\], for lane 9"),
        ([3], np.zeros((1, 7)), np.full((1, 3), -np.inf), r"Y\[0\], for lane 3"),
    ],
)
def test_a_bad_batch_is_refused_and_changes_nothing(
    lanes: list[int], W: np.ndarray, Y: np.ndarray, complaint: str
) -> None:
    batch = FactorBatch(SIZES)
    with pytest.raises(ValueError, match=complaint):
        batch.update(np.array(lanes), W, Y)
    assert all(same_bits(batch.extract(lane), single.init(SIZES)) for lane in range(LANES))


def test_a_factor_of_other_sizes_is_refused() -> None:
    batch = FactorBatch(SIZES)
    with pytest.raises(ValueError, match="rows has shape"):
        batch.insert(0, single.init(replace(SIZES, control_size=2)))
    with pytest.raises(ValueError, match="centre has shape"):
        batch.insert(0, single.init(replace(SIZES, window=3)))
    broken = single.init(SIZES)
    broken.D[0, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        batch.insert(0, broken)
    broken.D[0, 0], broken.R[1, 1] = 0.0, 0.0
    with pytest.raises(ValueError, match="diagonal positive"):
        batch.insert(0, broken)
    with pytest.raises(ValueError, match="expected 0 to 63"):
        batch.theta(64)
