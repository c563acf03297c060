"""The solver against enumeration, and what it says when things go wrong."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from koop_service.control import solve
from koop_service.control.condense import CondensedQP
from koop_service.control.optimality import kkt_residual
from koop_service.control.problem import build_lqr
from koop_service.control.proxqp import Answer
from koop_service.control.solve import solve_qp
from koop_service.prediction.rollout import rollout

from .systems import best_by_enumeration, pendulum, random_model, random_weight

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
    return lambda _H, g, *_, **__: Answer(np.full(len(g), x), np.zeros(0), empty)


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


# Rates


def random_rate_qp(rng, horizon=10, p=1, bounded=0.3, rate=0.5, radius=1.0):
    """A tracking problem with bounds, and rates that are `rate` of the bounds."""
    model = random_model(rng, p=p, radius=radius)
    history, target = rng.normal(size=(2, 8)), rng.normal(size=8)
    arguments = (model, history, target, horizon, 1.0, 0.1)
    free = build_lqr(*arguments)
    bound = np.quantile(np.abs(np.linalg.solve(free.H, free.g)), 1.0 - bounded)
    rates = {"du_min": -rate * bound, "du_max": rate * bound}
    return build_lqr(*arguments, -bound, bound, **rates, last_control=0.0)


@settings(deadline=None, max_examples=40)
@given(SEEDS, st.sampled_from([(2, 1), (3, 1), (2, 2)]), st.sampled_from([0.1, 0.5, 1.0]))
def test_with_rates_it_equals_enumeration_too(seed, size, rate):
    qp = random_rate_qp(np.random.default_rng(seed), *size, bounded=0.5, rate=rate)
    solution = solve_qp(qp)
    best = best_by_enumeration(qp)
    assert solution.status == "solved"
    np.testing.assert_allclose(solution.u.reshape(-1), best, atol=1e-9 * (1 + np.abs(best).max()))


@settings(deadline=None, max_examples=60)
@given(
    SEEDS,
    st.sampled_from([1, 10, 40]),
    st.integers(1, 2),
    st.sampled_from([0.5, 1.0, 1.05]),
    st.sampled_from([0.0, 0.02, 0.25, 1.0, 10.0]),
)
def test_rate_bounds_hold(seed, horizon, p, radius, rate):
    qp = random_rate_qp(np.random.default_rng(seed), horizon, p, 0.4, rate, radius)
    solution = solve_qp(qp)
    u = solution.u.reshape(-1)
    assert solution.status == "solved"
    assert solution.kkt_residual < 1e-8
    assert (u >= qp.lower).all()
    assert (u <= qp.upper).all()
    slack = 1e-12 * np.abs(qp.upper).max()
    assert (qp.changes(u) >= qp.rate_lower - slack).all()
    assert (qp.changes(u) <= qp.rate_upper + slack).all()
    assert kkt_residual(qp, u, solution.rates) == solution.kkt_residual


@settings(deadline=None, max_examples=80)
@example(722, 2, 1, 2, 25, 0.25, (1.3, 1e-2))  # takes the finer accuracy
@given(
    SEEDS,
    st.integers(1, 5),
    st.integers(1, 3),
    st.integers(1, 2),
    st.sampled_from([2, 5, 25]),
    st.sampled_from([0.0, 0.25, 0.5, 1.0]),
    st.sampled_from([(1.0, 1.0), (1.3, 1e-2), (1.3, 1e-4)]),
)
def test_no_size_and_no_round_rate_is_called_infeasible(seed, n, h, p, horizon, rate, hard):
    """At its own tolerance ProxQP calls one in a hundred of these so, well-conditioned ones too."""
    rng, (radius, weight) = np.random.default_rng(seed), hard
    model = random_model(rng, n, h, p, radius)
    rates = {"du_min": -rate, "du_max": rate, "last_control": 0.0}
    target = 30.0 * rng.normal(size=n)
    qp = build_lqr(model, rng.normal(size=(h, n)), target, horizon, 1, weight, -1, 1, **rates)
    assert solve_qp(qp).status == "solved"


def test_about_as_many_rates_are_active_as_these_tests_mean():
    rng = np.random.default_rng(0)
    shares = [np.mean(solve_qp(random_rate_qp(rng)).rates != 0.0) for _ in range(30)]
    assert 0.3 < np.mean(shares) < 0.8


def test_from_bound_to_bound_at_full_rate():
    """Both ends and every change between sit on bounds: the multipliers are not unique."""
    steps = 9
    goal = np.where(np.arange(steps) < 3, -50.0, 50.0)
    H = np.eye(steps) + 0.1
    qp = CondensedQP(
        H, -H @ goal, -np.ones(steps), np.ones(steps), 0.0, 1, -0.5 * np.ones(8), 0.5 * np.ones(8)
    )
    solution = solve_qp(qp)
    assert solution.status == "solved"
    moves = np.diff(solution.u[:, 0])
    assert solution.u[0, 0] == -1.0
    assert solution.u[-1, 0] == 1.0
    assert np.isclose(moves, 0.5).sum() == 4
    assert np.isclose(moves, 0.0, atol=1e-9).sum() == 4


def test_wrong_multipliers_make_the_residual_larger_never_smaller():
    rng = np.random.default_rng(1)
    qp = random_rate_qp(rng)
    solution = solve_qp(qp)
    u = solution.u.reshape(-1)
    assert np.abs(solution.rates).max() > 0.1
    assert kkt_residual(qp, u) > 1e-3
    assert kkt_residual(qp, u, -solution.rates) > 1e-3
    elsewhere = 0.9 * u
    for rates in (solution.rates, 0.0 * solution.rates, rng.normal(size=len(solution.rates))):
        assert kkt_residual(qp, elsewhere, rates) > 1e-3


@pytest.mark.filterwarnings("error")
def test_what_is_not_finite_fails_within_bounds_and_rates():
    model = random_model(np.random.default_rng(10), radius=50.0)
    rates = {"du_min": -0.25, "du_max": 0.25, "last_control": 2.0}
    qp = build_lqr(model, np.ones((2, 8)), np.zeros(8), 500, 1, 1, 0.5, 2, **rates)
    solution = solve_qp(qp)
    assert solution.status == "failed"
    np.testing.assert_array_equal(solution.u[:7, 0], [1.75, 1.5, 1.25, 1.0, 0.75, 0.5, 0.5])


def test_a_solver_that_lies_is_found_out_with_rates_too(monkeypatch):
    def lie(_H, g, *_, **__):
        return Answer(100.0 * np.sign(g), np.full(len(g) - 1, 7.0), False)

    monkeypatch.setattr(solve, "solve_box", lie)
    statuses = set()
    for seed in range(10):
        qp = random_rate_qp(np.random.default_rng(seed), horizon=40)
        solution = solve_qp(qp)
        u = solution.u.reshape(-1)
        statuses.add(solution.status)
        assert (solution.status == "solved") == (kkt_residual(qp, u, solution.rates) <= 1e-6)
        assert (np.abs(u) <= qp.upper.max()).all()
        assert (np.abs(qp.changes(u)) <= qp.rate_upper + 1e-12).all()
    assert "inaccurate" in statuses


# From the last solution


def receding(seed, rates, steps=40, horizon=12):
    """A pendulum that is kicked now and then: each step's QP with the step before's solution."""
    rng = np.random.default_rng(seed)
    model, history, last, u = pendulum(), np.array([[0.2, 0.0]]), None, np.zeros(1)
    limits = {"du_min": -3.0, "du_max": 3.0} if rates else {}
    for t in range(steps):
        arguments = (model, history, np.zeros(2), horizon, 1.0, 1e-3, -8.0, 8.0)
        qp = build_lqr(*arguments, **limits, last_control=u)
        yield qp, last
        last = solve_qp(qp, last)
        u = last.u[0]
        kick = 0.8 * (t % 15 == 14)
        history = rollout(model, history, u[None]) + 1e-3 * rng.normal(size=(1, 2)) + [0, kick]


@pytest.mark.parametrize("rates", [False, True])
def test_the_shifted_last_solution_is_a_start_and_the_answer_is_the_same(rates):
    warm, active = [], []
    for qp, last in receding(0, rates):
        found, cold = solve_qp(qp, last), solve_qp(qp)
        assert found.status == cold.status == "solved"
        assert found.kkt_residual <= 1e-9
        np.testing.assert_allclose(found.u, cold.u, atol=1e-8 * 8)
        warm.append(found.warm)
        active.append((cold.rates != 0.0).any() or (np.abs(cold.u) == 8.0).any())
        assert not cold.warm
    assert np.mean(warm) > 0.8
    assert np.sum(active) > 3  # else there was nothing to start from


def test_a_warm_start_does_without_the_solver(monkeypatch):
    cases = list(receding(1, rates=True))
    monkeypatch.setattr(solve, "solve_box", None)
    qp, last = cases[-1]
    assert solve_qp(qp, last).status == "solved"


@pytest.mark.parametrize("rates", [False, True])
def test_the_last_solution_of_something_else_does_no_harm(rates):
    make = random_rate_qp if rates else random_qp
    rng = np.random.default_rng(2)
    for _ in range(20):
        qp, other = make(rng), solve_qp(make(rng))
        found = solve_qp(qp, other, elapsed=3)
        assert found.status == "solved"
        np.testing.assert_allclose(found.u, solve_qp(qp).u, atol=1e-7)
    for last in (solve_qp(make(rng, horizon=5)), solve_qp(make(rng, p=2))):
        assert not solve_qp(qp, last).warm
    broken = replace(other, u=np.full_like(other.u, np.nan))
    assert solve_qp(qp, broken).status == "solved"
