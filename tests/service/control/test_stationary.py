"""The infinite horizon: scipy's Riccati solver, what it promises, and when there is none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from koop_service.control.problem import build_lqr
from koop_service.control.riccati import lqr_riccati
from koop_service.control.solve import solve_qp
from koop_service.control.stationary import state_weight, stationary_cost, stationary_gain
from koop_service.prediction.model import LinearModel

from .systems import closed_loop, pendulum, random_model, random_weight

SEEDS = st.integers(0, 2**32 - 1)


@settings(deadline=None, max_examples=60)
@given(
    SEEDS, st.integers(1, 4), st.integers(1, 3), st.integers(1, 2), st.sampled_from([0.5, 1.0, 1.2])
)
def test_equals_scipys_solution(seed, n, h, p, radius):
    rng = np.random.default_rng(seed)
    model = random_model(rng, n, h, p, radius)
    Q, R = random_weight(rng, n), random_weight(rng, p)
    P = stationary_cost(model, Q, R)
    assert P is not None
    weight = state_weight(model, Q)
    expected = solve_discrete_are(model.companion(), model.companion_input(), weight, R)
    np.testing.assert_allclose(P, expected, atol=1e-6 * np.abs(expected).max())
    K = stationary_gain(model, R, P)
    closed = model.companion() - model.companion_input() @ K
    assert np.abs(np.linalg.eigvals(closed)).max() < 1.0


@settings(deadline=None, max_examples=30)
@given(SEEDS, st.integers(1, 3), st.integers(1, 2), st.integers(1, 8))
def test_a_short_plan_that_ends_in_it_begins_as_an_endless_one(seed, h, p, horizon):
    rng = np.random.default_rng(seed)
    model = random_model(rng, 3, h, p, 1.1, affine=False)
    history = rng.normal(size=(h, 3))
    P = stationary_cost(model, np.eye(3), np.eye(p))
    assert P is not None
    expected = -stationary_gain(model, np.eye(p), P) @ history.reshape(-1)
    arguments = (model, history, np.zeros(3), horizon, 1.0, 1.0)
    solution = solve_qp(build_lqr(*arguments, Qf="riccati"))
    for u in (solution.u, lqr_riccati(*arguments, Qf="riccati")):
        np.testing.assert_allclose(u[0], expected, atol=1e-7 * (1 + np.abs(expected).max()))
    x = history.reshape(-1)
    endless = x @ P @ x - history[-1] @ history[-1]  # z_0 is given: eq. 13 does not count it
    assert solution.cost == pytest.approx(endless, rel=1e-6)


def test_no_control_reaches_the_mode_that_grows():
    A, B = np.diag([1.1, 0.5]), np.array([[0.0], [1.0]])
    assert stationary_cost(LinearModel(A, B, np.zeros(2)), np.eye(2), np.eye(1)) is None
    shrinking = LinearModel(np.diag([0.9, 0.5]), B, np.zeros(2))
    assert stationary_cost(shrinking, np.eye(2), np.eye(1)) is not None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("radius", [3.0, 1e3, 1e80, 1e150])
def test_a_wild_model_has_a_solution_or_none(radius):
    model = random_model(np.random.default_rng(0), radius=radius)
    P = stationary_cost(model, np.eye(8), np.eye(1))
    assert P is None or np.isfinite(P).all()


def test_a_weight_that_does_not_see_the_growth_gives_no_stabilising_gain():
    model = LinearModel(np.diag([1.1, 0.5]), np.eye(2), np.zeros(2))
    assert stationary_cost(model, np.diag([0.0, 1.0]), np.eye(2)) is None


def test_without_its_end_a_short_plan_lets_the_pendulum_fall():
    """Why there is a terminal weight: two steps ahead, falling looks cheaper than the torque."""
    model = pendulum()

    def angle(Qf):
        def controller(history, _last, _t):
            return solve_qp(build_lqr(model, history, np.zeros(2), 2, 1.0, 1.0, Qf=Qf)).u[0]

        return closed_loop(model, np.array([[0.1, 0.0]]), controller, 60)[0][-1, 0]

    assert abs(angle("riccati")) < 1e-3
    assert abs(angle(None)) > 1.0
