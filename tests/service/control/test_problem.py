"""Condensing: the QP's cost is the roll-out's cost, for any controls."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.control.problem import build_lqr

from .systems import random_model, random_weight, simulated_cost

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
