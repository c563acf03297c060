"""Condensing: the QP's cost is the roll-out's cost, for any controls."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.control.problem import build_lqr
from koop_service.control.solve import solve_qp
from koop_service.control.stationary import state_weight
from koop_service.prediction.rollout import rollout

from .systems import closed_loop, pendulum, random_model, random_weight, simulated_cost

SEEDS = st.integers(0, 2**32 - 1)


@settings(deadline=None)
@given(
    SEEDS, st.integers(1, 5), st.integers(1, 3), st.integers(1, 3), st.integers(1, 8), st.booleans()
)
def test_the_condensed_cost_is_the_simulated_cost(seed, n, h, p, horizon, affine):
    rng = np.random.default_rng(seed)
    model = random_model(rng, n, h, p, affine=affine)
    history, target = rng.normal(size=(h, n)), rng.normal(size=n)
    Q, R = random_weight(rng, n), random_weight(rng, p)
    qp = build_lqr(model, history, target, horizon, Q, R)
    for scale in (0.0, 1.0, 100.0):
        u = scale * rng.normal(size=(horizon, p))
        expected = simulated_cost(model, history, target, u, Q, R)
        assert qp.cost(u) == pytest.approx(expected, rel=1e-9)
        assert qp.cost(u.reshape(-1)) == qp.cost(u)


@settings(deadline=None, max_examples=30)
@given(SEEDS, st.integers(1, 3), st.integers(1, 6))
def test_the_gradient_is_that_of_the_simulated_cost(seed, p, horizon):
    rng = np.random.default_rng(seed)
    model = random_model(rng, 4, 2, p)
    history, target = rng.normal(size=(2, 4)), rng.normal(size=4)
    Q, R = random_weight(rng, 4), random_weight(rng, p)
    qp = build_lqr(model, history, target, horizon, Q, R)
    u, way = rng.normal(size=(2, horizon, p))
    # The cost is quadratic: a central difference is exact but for rounding, at any step.
    ahead = simulated_cost(model, history, target, u + way, Q, R)
    behind = simulated_cost(model, history, target, u - way, Q, R)
    slope = qp.gradient(u) @ way.reshape(-1)
    assert slope == pytest.approx((ahead - behind) / 2, rel=1e-8, abs=1e-9 * (ahead + behind))


def test_the_hessian_is_symmetric_positive_definite():
    rng = np.random.default_rng(0)
    model = random_model(rng, p=2, radius=1.1)
    R = random_weight(rng, 2)
    qp = build_lqr(model, np.ones((2, 8)), np.zeros(8), 20, random_weight(rng, 8), R)
    np.testing.assert_allclose(qp.H, qp.H.T, rtol=1e-12)
    assert np.linalg.eigvalsh(qp.H).min() >= 2 * np.linalg.eigvalsh(R).min() * (1 - 1e-9)


def test_a_number_a_diagonal_and_a_matrix_are_the_same_weight():
    model = random_model(np.random.default_rng(1), p=2)
    history, target = np.ones((2, 8)), np.zeros(8)
    one = build_lqr(model, history, target, 5, 2.0, 0.5)
    diagonal = build_lqr(model, history, target, 5, np.full(8, 2.0), np.full(2, 0.5))
    matrix = build_lqr(model, history, target, 5, 2.0 * np.eye(8), 0.5 * np.eye(2))
    for other in (diagonal, matrix):
        np.testing.assert_array_equal(one.H, other.H)
        np.testing.assert_array_equal(one.g, other.g)


def test_bounds_hold_at_every_step_and_may_be_one_sided():
    model = random_model(np.random.default_rng(2), p=2)
    qp = build_lqr(model, np.ones((2, 8)), np.zeros(8), 3, 1, 1, [-1, -np.inf], [2, 3])
    np.testing.assert_array_equal(qp.lower, [-1, -np.inf] * 3)
    np.testing.assert_array_equal(qp.upper, [2, 3] * 3)
    qp = build_lqr(model, np.ones((2, 8)), np.zeros(8), 3, 1, 1, u_max=0.5)
    np.testing.assert_array_equal(qp.lower, [-np.inf] * 6)
    np.testing.assert_array_equal(qp.upper, [0.5] * 6)


def test_a_semidefinite_Q_is_welcome():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(8, 3))
    qp = build_lqr(random_model(rng), np.ones((2, 8)), np.zeros(8), 4, root @ root.T, 1)
    assert np.linalg.eigvalsh(qp.H).min() >= 2 - 1e-9


def test_a_sequence_that_ends_early_rests_on_its_last_code():
    rng = np.random.default_rng(4)
    model, history = random_model(rng), rng.normal(size=(2, 8))
    short = rng.normal(size=(3, 8))
    long = np.concatenate([short, np.tile(short[-1], (9, 1))])  # 12 rows: those past N are unused
    one, other = (build_lqr(model, history, target, 6, 1, 1) for target in (short, long))
    np.testing.assert_array_equal(one.g, other.g)
    assert one.constant == other.constant
    assert not np.allclose(one.g, build_lqr(model, history, short[::-1], 6, 1, 1).g)


def test_the_last_code_and_the_last_state_may_be_weighted():
    rng = np.random.default_rng(5)
    model, history, target = random_model(rng), rng.normal(size=(2, 8)), rng.normal(size=8)
    Q = random_weight(rng, 8)
    eq13, code, state = (
        build_lqr(model, history, target, 7, Q, 1, Qf=Qf)
        for Qf in (None, Q, state_weight(model, Q))
    )
    for other in (code, state):
        np.testing.assert_allclose(other.H, eq13.H, rtol=1e-12)
        np.testing.assert_allclose(other.g, eq13.g, rtol=1e-12)
    heavy = build_lqr(model, history, target, 7, Q, 1, Qf=1e6)
    ends = [
        np.linalg.norm(rollout(model, history, solve_qp(qp).u)[-1] - target) for qp in (eq13, heavy)
    ]
    assert ends[1] < ends[0]


def test_a_model_that_no_control_makes_stable_ends_as_eq13_does():
    model = random_model(np.random.default_rng(6), radius=1.2)
    model = type(model)(model.A, 0.0 * model.B, model.c)
    arguments = (model, np.ones((2, 8)), np.zeros(8), 5, 1, 1)
    endless = build_lqr(*arguments, Qf="riccati")
    np.testing.assert_array_equal(endless.H, build_lqr(*arguments).H)


def test_the_first_step_obeys_the_rate_too():
    model = random_model(np.random.default_rng(7), p=2)
    arguments = (model, np.ones((2, 8)), np.zeros(8), 3, 1, 1, -1.0, 1.0)
    rates = {"du_min": [-0.25, -np.inf], "du_max": 0.5}
    qp = build_lqr(*arguments, **rates, last_control=[0.75, 0.0])
    np.testing.assert_array_equal(qp.lower, [0.5, -1.0, -1.0, -1.0, -1.0, -1.0])
    np.testing.assert_array_equal(qp.upper, [1.0, 0.5, 1.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(qp.rate_lower, [-0.25, -np.inf] * 2)
    np.testing.assert_array_equal(qp.rate_upper, [0.5] * 4)
    free = build_lqr(*arguments, **rates)
    np.testing.assert_array_equal(free.lower, [-1.0] * 6)
    assert len(build_lqr(*arguments, last_control=0.0).rate_lower) == 0


def test_a_last_control_out_of_its_bounds_by_rounding_is_no_contradiction():
    model = random_model(np.random.default_rng(8))
    last = 1.0 + 0.1 + 1e-15
    qp = build_lqr(
        model, np.ones((2, 8)), np.zeros(8), 3, 1, 1, -1, 1, du_min=-0.1, last_control=last
    )
    assert qp.lower[0] == qp.upper[0] == 1.0


def test_known_channels_are_what_they_are_given_as():
    rng = np.random.default_rng(9)
    model, history = random_model(rng, p=2), rng.normal(size=(2, 8))
    wind = [5.0, -5.0, 0.5]
    bounds = {"u_min": -1, "u_max": 1, "du_min": -0.1, "du_max": 0.1, "last_control": [0.0, 9.0]}
    qp = build_lqr(model, history, np.zeros(8), 5, 1, 1, **bounds, known={1: wind})
    solution = solve_qp(qp)
    assert solution.status == "solved"
    np.testing.assert_array_equal(solution.u[:, 1], [5.0, -5.0, 0.5, 0.5, 0.5])
    moves = np.abs(np.diff(solution.u[:, 0], prepend=0.0))
    assert 0.09 < moves.max() <= 0.1 + 1e-12


def test_with_preview_a_disturbance_does_less_harm():
    model, steps = pendulum(p=2), 30
    gust = np.zeros(steps + 10)
    gust[12:16] = 20.0

    def cost(preview):
        def controller(history, _last, t):
            wind = gust[t : t + 10] if preview else [gust[t]]  # else it is thought to last
            qp = build_lqr(model, history, np.zeros(2), 10, 1.0, 1e-3, -9, 9, known={1: wind})
            return solve_qp(qp).u[0]

        codes, controls = closed_loop(model, np.zeros((1, 2)), controller, steps)
        np.testing.assert_array_equal(controls[:, 1], gust[:steps])
        return np.sum(codes**2)

    assert cost(preview=True) < 0.8 * cost(preview=False)


@pytest.mark.parametrize("h", [1, 2, 3])
def test_a_moving_target_is_tracked_by_seeing_it_come(h):
    """An angle that swings, on a plant that needs a torque to lean: a step ahead is too late."""
    model, steps, N = pendulum(h=h), 60, 12
    angle = 0.3 * np.sin(0.15 * np.arange(steps + N + 1))
    path = np.stack([angle, np.gradient(angle, 0.05)], axis=1)

    def error(preview):
        def controller(history, last, t):
            ahead = path[t + 1 : t + 1 + N] if preview else path[t]
            bounds = {"du_min": -3, "du_max": 3, "last_control": last}
            qp = build_lqr(model, history, ahead, N, [10.0, 1.0], 1e-4, -15, 15, **bounds)
            solution = solve_qp(qp)
            assert solution.status == "solved"
            return solution.u[0]

        codes, controls = closed_loop(model, np.tile(path[0], (h, 1)), controller, steps)
        assert np.abs(np.diff(controls[:, 0], prepend=0.0)).max() <= 3 + 1e-9
        assert np.abs(controls).max() <= 15
        return np.abs(codes[20:, 0] - path[21 : steps + 1, 0]).max()

    assert error(preview=True) < 0.05
    assert error(preview=False) > 2 * error(preview=True)


def bad(**changed):
    arguments = {
        "history": np.zeros((2, 8)),
        "target": np.zeros(8),
        "horizon": 5,
        "Q": 1.0,
        "R": 1.0,
        "u_min": None,
        "u_max": None,
    }
    return arguments | changed


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (bad(horizon=0), "horizon is 0; expected a whole number"),
        (bad(horizon=-3), "horizon is -3"),
        (bad(horizon=2.5), r"horizon is 2\.5"),
        (bad(horizon=True), "horizon is True"),
        (bad(horizon=float("nan")), "horizon is nan"),
        (bad(horizon=float("inf")), "horizon is inf"),
        (bad(history=np.zeros((3, 8))), r"history has shape \(3, 8\); expected \(2, 8\)"),
        (bad(history=np.full((2, 8), np.nan)), "history has NaN"),
        (bad(target=np.zeros(7)), r"target has shape \(7,\)"),
        (bad(target=np.full(8, np.inf)), "target has NaN or infinity"),
        (bad(Q=np.ones(7)), "Q has shape"),
        (bad(Q=np.eye(7)), "Q has shape"),
        (bad(Q=np.full(8, np.nan)), "Q has NaN"),
        (bad(Q=-1.0), "Q is not positive semidefinite"),
        (bad(Q=np.diag([1.0] * 7 + [-1e-3])), "Q is not positive semidefinite"),
        (bad(Q=np.triu(np.ones((8, 8)))), "Q is not symmetric"),
        (bad(R=0.0), "R is not positive definite"),
        (bad(R=[1.0, 0.0]), "R is not positive definite"),
        (bad(R=np.ones((2, 2))), "R is not positive definite"),
        (bad(R=np.array([[1.0, 0.5], [0.0, 1.0]])), "R is not symmetric"),
        (bad(R=np.ones(3)), "R has shape"),
        (bad(R=np.inf), "R has NaN or infinity"),
        (bad(u_min=1.0, u_max=-1.0), "expected u_min <= u_max"),
        (bad(u_min=[0, 2], u_max=1.0), "expected u_min <= u_max"),
        (bad(u_min=np.inf), "finite control"),
        (bad(u_max=-np.inf), "finite control"),
        (bad(u_min=np.nan), "u_min has NaN"),
        (bad(u_max=[1.0, 1.0, 1.0]), "u_max has shape"),
        (bad(target=np.zeros((0, 8))), r"target has shape \(0, 8\)"),
        (bad(target=np.zeros((3, 2, 8))), r"target has shape"),
        (bad(target=np.full((3, 8), np.nan)), "target has NaN"),
        (bad(Qf="ricatti"), "Qf is 'ricatti'"),
        (bad(Qf=np.ones(7)), "Qf has shape"),
        (bad(Qf=np.full(8, np.nan)), "Qf has NaN"),
        (bad(Qf=-np.eye(16)), "Qf is not positive semidefinite"),
        (bad(du_min=0.1), "expected du_min <= 0 <= du_max"),
        (bad(du_max=[1.0, -0.1]), "expected du_min <= 0 <= du_max"),
        (bad(du_max=np.nan), "du_max has NaN"),
        (bad(last_control=[0.0, np.nan]), "last_control is"),
        (bad(last_control=[0.0] * 3), "last_control is"),
        (bad(u_max=1.0, du_min=-0.5, last_control=2.0), "allow a faster change"),
        (bad(known={2: 0.0}), "known has channel 2; expected 0 to 1"),
        (bad(known={0: 0.0, 1: 0.0}), "at least one to decide"),
        (bad(known={0: []}), r"known\[0\] has shape \(0,\)"),
        (bad(known={0: [0.0, np.inf]}), r"known\[0\]"),
    ],
)
def test_bad_arguments_say_what_was_wrong(arguments, problem):
    model = random_model(np.random.default_rng(0), p=2)
    with pytest.raises(ValueError, match=problem):
        build_lqr(model, **arguments)


def test_an_unforced_model_has_nothing_to_control():
    model = random_model(np.random.default_rng(0), p=0)
    with pytest.raises(ValueError, match="no control input"):
        build_lqr(model, **bad())
