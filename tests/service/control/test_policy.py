"""The gain with saturation: optimal where nothing is active, inside its bounds everywhere."""

import numpy as np
import pytest

from koop_service.control.policy import stationary_policy
from koop_service.control.problem import build_lqr
from koop_service.control.solve import solve_qp
from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import rollout

from .systems import closed_loop, pendulum, random_model


@pytest.mark.parametrize(("h", "p"), [(1, 1), (2, 1), (3, 2)])
def test_it_plans_as_the_qp_does_where_no_bound_is_active(h, p):
    rng = np.random.default_rng(h)
    model = random_model(rng, 4, h, p, 1.1, affine=False)
    history = rng.normal(size=(h, 4))
    policy = stationary_policy(model, np.zeros(4), 1.0, 0.1)
    assert policy is not None
    qp = build_lqr(model, history, np.zeros(4), 8, 1.0, 0.1, Qf="riccati")
    expected = solve_qp(qp).u
    np.testing.assert_allclose(policy.plan(history, 8), expected, atol=1e-7)
    assert policy.radius() < 1.0


def test_it_holds_a_lean_that_needs_a_torque():
    """An affine target: the offset comes from the equilibrium, not from a standing error."""
    model = pendulum(h=2)
    model = LinearModel(model.A, model.B, np.array([0.0, 0.02]))
    target = np.array([0.2, 0.0])
    policy = stationary_policy(model, target, 1.0, 0.01, -10, 10)
    assert policy is not None
    codes, controls = closed_loop(
        model, np.zeros((2, 2)), lambda seen, last, _t: policy.control(seen, last), 200
    )
    np.testing.assert_allclose(codes[-1], target, atol=1e-6)
    np.testing.assert_allclose(controls[-1], -20.0 * 0.2 - 0.02 / 0.05, atol=1e-5)


def test_it_saturates_and_stays_within_its_rate():
    model = pendulum()
    policy = stationary_policy(model, np.zeros(2), 1.0, 1e-4, -6, 6, -1.5, 1.5)
    assert policy is not None
    codes, controls = closed_loop(
        model, np.array([[0.15, 0.0]]), lambda seen, last, _t: policy.control(seen, last), 120
    )
    moves = np.abs(np.diff(controls[:, 0], prepend=0.0))
    assert moves.max() == pytest.approx(1.5)
    assert np.abs(controls).max() == 6.0
    assert np.abs(codes[-1]).max() < 1e-3
    history = np.array([[0.15, 0.0]])
    plan = policy.plan(history, 120, np.zeros(1))
    np.testing.assert_allclose(plan, controls, atol=1e-9)
    np.testing.assert_allclose(rollout(model, history, plan), codes, atol=1e-9)


def test_there_is_none_for_a_model_that_cannot_be_stabilised():
    model = LinearModel(np.diag([1.1, 0.5]), np.array([[0.0], [1.0]]), np.zeros(2))
    assert stationary_policy(model, np.zeros(2), 1.0, 1.0) is None


def test_bad_arguments_say_what_was_wrong():
    model = pendulum()
    with pytest.raises(ValueError, match="R has NaN"):
        stationary_policy(model, np.zeros(2), 1.0, np.nan)
    with pytest.raises(ValueError, match="expected a code, 2 finite numbers"):
        stationary_policy(model, np.zeros(3), 1.0, 1.0)
    with pytest.raises(ValueError, match="du_min <= 0"):
        stationary_policy(model, np.zeros(2), 1.0, 1.0, du_min=1.0)
    with pytest.raises(ValueError, match="no control input"):
        stationary_policy(random_model(np.random.default_rng(0), p=0), np.zeros(8), 1.0, 1.0)
