"""The solver against enumeration, and what it says when things go wrong."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.control import solve
from koop_service.control.problem import build_lqr
from koop_service.control.solve import kkt_residual, solve_qp

from .systems import best_by_enumeration, random_model, random_weight

SEEDS = st.integers(0, 2**32 - 1)


def random_qp(rng, horizon=10, p=1, radius=1.0, weight=0.1, bounded=0.4):
    """A tracking problem with roughly the share `bounded` of its controls on a bound."""
    model = random_model(rng, p=p, radius=radius)
    history, target = rng.normal(size=(2, 8)), rng.normal(size=8)
    free = build_lqr(model, history, target, horizon, 1.0, weight)
    bound = np.quantile(np.abs(np.linalg.solve(free.H, free.g)), 1.0 - bounded)
    return replace(free, lower=np.full(horizon * p, -bound), upper=np.full(horizon * p, bound))


@settings(deadline=None, max_examples=60)
@given(SEEDS, st.integers(1, 3), st.integers(1, 2))
def test_equals_enumeration_of_the_active_sets(seed, horizon, p):
    qp = random_qp(np.random.default_rng(seed), horizon, p, bounded=0.5)
    solution = solve_qp(qp)
    best = best_by_enumeration(qp)
    assert solution.status == "solved"
    np.testing.assert_allclose(solution.u.reshape(-1), best, atol=1e-9 * (1 + np.abs(best).max()))
    assert solution.cost == pytest.approx(qp.cost(best), rel=1e-10, abs=1e-10)


@settings(deadline=None, max_examples=100)
@given(
    SEEDS,
    st.sampled_from([1, 10, 40]),
    st.integers(1, 3),
    st.sampled_from([0.5, 1.0, 1.05]),
    st.sampled_from([1e-3, 1e-1, 10.0]),
)
def test_random_problems_are_solved_inside_their_bounds(seed, horizon, p, radius, weight):
    qp = random_qp(np.random.default_rng(seed), horizon, p, radius, weight)
    solution = solve_qp(qp)
    u = solution.u.reshape(-1)
    assert solution.status == "solved"
    assert solution.kkt_residual < 1e-8
    assert (qp.lower <= u).all()
    assert (u <= qp.upper).all()
    assert solution.u.shape == (horizon, p)
    assert multiplier_residual(qp, u) < 1e-6


def multiplier_residual(qp, u):
    """KKT by multipliers: the gradient must vanish off the bounds and point outwards on them."""
    gradient = qp.gradient(u) / np.abs(qp.g).max()
    outwards = np.where(u == qp.lower, np.minimum(gradient, 0.0), gradient)
    outwards = np.where(u == qp.upper, np.maximum(gradient, 0.0), outwards)
    return np.abs(np.where(qp.lower == qp.upper, 0.0, outwards)).max()


def test_about_as_many_bounds_are_active_as_these_tests_mean():
    rng = np.random.default_rng(0)
    shares = [np.mean(on_bound(qp := random_qp(rng), solve_qp(qp))) for _ in range(50)]
    assert 0.25 < np.mean(shares) < 0.6


def on_bound(qp, solution):
    u = solution.u.reshape(-1)
    return (u == qp.lower) | (u == qp.upper)


@pytest.mark.parametrize("unit", [1e-10, 1e-3, 1e4, 1e10])
def test_the_unit_of_the_control_and_of_the_cost_do_not_matter(unit):
    qp = random_qp(np.random.default_rng(5), horizon=40, p=3, bounded=0.6)
    scaled = replace(
        qp, H=qp.H / unit, g=qp.g, lower=qp.lower * unit, upper=qp.upper * unit, constant=0.0
    )
    solution = solve_qp(scaled)
    assert solution.status == "solved"
    np.testing.assert_allclose(solution.u / unit, solve_qp(qp).u, rtol=1e-8, atol=1e-12)


def test_equal_bounds_fix_the_control():
    model = random_model(np.random.default_rng(6), p=2)
    qp = build_lqr(model, np.ones((2, 8)), np.zeros(8), 5, 1, 1, [0.3, -1], [0.3, 1])
    solution = solve_qp(qp)
    assert solution.status == "solved"
    np.testing.assert_array_equal(solution.u[:, 0], 0.3)
    free = qp.gradient(solution.u).reshape(5, 2)[:, 1]
    np.testing.assert_allclose(free[np.abs(solution.u[:, 1]) < 1], 0.0, atol=1e-9)


def test_already_at_rest_on_the_target_nothing_is_done():
    model = random_model(np.random.default_rng(7), affine=False)
    solution = solve_qp(build_lqr(model, np.zeros((2, 8)), np.zeros(8), 10, 1, 1, -1, 1))
    assert (solution.status, solution.cost, solution.kkt_residual) == ("solved", 0.0, 0.0)
    np.testing.assert_array_equal(solution.u, 0.0)


def test_the_same_problem_has_the_same_bits():
    qp = random_qp(np.random.default_rng(8))
    np.testing.assert_array_equal(solve_qp(qp).u, solve_qp(qp).u)


def test_the_kkt_residual_notices_a_wrong_answer():
    qp = random_qp(np.random.default_rng(9))
    u = solve_qp(qp).u.reshape(-1)
    inside = int(np.argmin(np.abs(u)))
    on_bound = int(np.argmax(np.abs(u)))
    assert abs(u[on_bound]) == qp.upper[on_bound]
    for wrong in (inside, on_bound):
        moved = u.copy()
        moved[wrong] -= 1e-3 * np.sign(moved[wrong]) * qp.upper[wrong]
        assert kkt_residual(qp, moved) > 1e-5


@pytest.mark.filterwarnings("error")
def test_an_unstable_model_over_a_long_horizon_fails_with_a_status():
    model = random_model(np.random.default_rng(10), radius=50.0)
    qp = build_lqr(model, np.ones((2, 8)), np.zeros(8), 500, 1, 1, 0.5, 2)
    assert not np.isfinite(qp.H).all()
    solution = solve_qp(qp)
    assert solution.status == "failed"
    assert solution.cost == solution.kkt_residual == np.inf
    np.testing.assert_array_equal(solution.u, 0.5)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("radius", [1.5, 3.0, 10.0])
def test_an_ill_conditioned_problem_is_never_called_solved_wrongly(radius):
    rng = np.random.default_rng(11)
    model = random_model(rng, radius=radius)
    qp = build_lqr(model, rng.normal(size=(2, 8)), np.zeros(8), 40, 1, 1e-6, -1, 1)
    solution = solve_qp(qp)
    assert (np.abs(solution.u) <= 1).all()
    assert (solution.status == "solved") == (kkt_residual(qp, solution.u.reshape(-1)) <= 1e-6)


@pytest.mark.filterwarnings("error")
def test_close_to_overflow_every_answer_is_a_number_or_a_failure():
    model = random_model(np.random.default_rng(14), radius=50.0)
    outcomes = set()
    for horizon in range(5, 120):
        solution = solve_qp(build_lqr(model, np.ones((2, 8)), np.zeros(8), horizon, 1, 1, -1, 2))
        outcomes.add(solution.status)
        assert np.isfinite(solution.u).all()
        assert not np.isnan([solution.cost, solution.kkt_residual]).any()
        assert (solution.status == "failed") == (solution.cost == np.inf)
    assert "failed" in outcomes


def answering(x, empty):
    return lambda _H, g, *_, **__: (np.full(len(g), x), empty)


@pytest.mark.parametrize(
    ("x", "empty", "status"),
    [(0.0, False, "inaccurate"), (np.nan, False, "inaccurate"), (np.nan, True, "infeasible")],
)
def test_what_the_solver_claims_does_not_make_it_solved(monkeypatch, x, empty, status):
    monkeypatch.setattr(solve, "solve_box", answering(x, empty))
    qp = random_qp(np.random.default_rng(12), horizon=40, p=2)
    solution = solve_qp(qp)
    assert solution.status == status
    assert solution.kkt_residual > 1e-6
    assert (np.abs(solution.u) <= qp.upper[0]).all()


def test_full_weights_and_many_controls():
    rng = np.random.default_rng(13)
    model = random_model(rng, n=6, h=3, p=4)
    Q, R = random_weight(rng, 6), random_weight(rng, 4)
    qp = build_lqr(model, rng.normal(size=(3, 6)), rng.normal(size=6), 12, Q, R, -0.1, 0.2)
    solution = solve_qp(qp)
    assert solution.status == "solved"
    assert solution.kkt_residual < 1e-8
    assert on_bound(qp, solution).any()
