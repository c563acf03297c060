"""Whether a target can be held at rest."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.control.equilibrium import (
    nearest_equilibrium,
    resting_control,
    why_unreachable,
)
from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import rollout

from .systems import pendulum, random_model


def test_with_as_many_controls_as_codes_every_target_can_be_held():
    model = random_model(np.random.default_rng(0), n=2, h=3, p=2)
    target = np.array([0.3, -2.0])
    u, drift = resting_control(model, target)
    np.testing.assert_allclose(drift, 0.0, atol=1e-12)
    codes = rollout(model, np.tile(target, (3, 1)), np.tile(u, (5, 1)))
    np.testing.assert_allclose(codes, np.tile(target, (5, 1)), atol=1e-10)
    rest = nearest_equilibrium(model, target)
    np.testing.assert_allclose(rest.control, u, atol=1e-8)
    assert rest.distance < 1e-8


def test_the_drift_is_the_next_code_less_the_target_and_no_control_makes_it_smaller():
    rng = np.random.default_rng(1)
    model, target = random_model(rng), rng.normal(size=8)
    u, drift = resting_control(model, target)
    history = np.tile(target, (2, 1))
    np.testing.assert_allclose(rollout(model, history, u[None])[0] - target, drift, atol=1e-12)
    for _ in range(20):
        other = rollout(model, history, u[None] + rng.normal(size=(1, 1)))[0] - target
        assert np.linalg.norm(other) > np.linalg.norm(drift)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 2), st.booleans())
def test_it_rests_within_the_bounds_and_nothing_that_rests_is_nearer(seed, h, p, affine):
    rng = np.random.default_rng(seed)
    model, target = random_model(rng, 4, h, p, 0.9, affine), rng.normal(size=4)
    rest = nearest_equilibrium(model, target, -0.2, 0.3)
    assert (rest.control >= -0.2).all()
    assert (rest.control <= 0.3).all()
    assert rest.drift < 1e-6
    codes = rollout(model, np.tile(rest.code, (h, 1)), np.tile(rest.control, (3, 1)))
    np.testing.assert_allclose(codes, np.tile(rest.code, (3, 1)), atol=1e-6)
    E = np.eye(4) - model.A.reshape(4, h, 4).sum(axis=1)
    for u in rng.uniform(-0.2, 0.3, size=(20, p)):
        other = np.linalg.solve(E, model.B @ u + model.c)
        assert np.linalg.norm(other - target) >= rest.distance * (1 - 1e-6)


def test_a_lean_beyond_the_torque_is_as_far_as_the_torque_holds():
    model, target = pendulum(), np.array([0.5, 0.0])
    rest = nearest_equilibrium(model, target, -4.0, 4.0)
    np.testing.assert_allclose(rest.code, [0.2, 0.0], atol=1e-6)
    assert rest.distance == pytest.approx(0.3, abs=1e-6)
    history, noise = np.zeros((1, 2)), 1e-4 * np.eye(2)
    assert "0.3 from the target, which is 0.5 away" in why_unreachable(rest, target, history, noise)
    wide = nearest_equilibrium(model, target, -40.0, 40.0)
    np.testing.assert_allclose(wide.control, -10.0, atol=1e-6)
    assert why_unreachable(wide, target, history, noise) == ""
    assert why_unreachable(rest, target, history, np.eye(2)) == ""  # 0.3 is nothing in such noise


def test_an_integrator_rests_anywhere_unless_something_pushes_it():
    A, B = np.diag([1.0, 0.5]), np.array([[1.0], [0.0]])
    anywhere = nearest_equilibrium(LinearModel(A, B, np.zeros(2)), np.array([3.0, 1.0]), -1, 1)
    np.testing.assert_allclose(anywhere.code, [3.0, 0.0], atol=1e-6)
    assert anywhere.drift < 1e-6
    pushed = nearest_equilibrium(LinearModel(A, B, np.array([4.0, 0.0])), np.zeros(2), -1, 1)
    np.testing.assert_allclose(pushed.control, [-1.0])
    assert pushed.drift == pytest.approx(3.0, rel=1e-3)


def test_a_control_that_does_nothing_is_left_alone():
    rest = nearest_equilibrium(pendulum(), np.zeros(2), 1.0, 2.0)
    assert rest.control[0] == pytest.approx(1.0)
    still = LinearModel(np.array([[0.5]]), np.zeros((1, 2)), np.ones(1))
    np.testing.assert_allclose(nearest_equilibrium(still, np.ones(1)).control, 0.0)


def test_bad_targets_say_what_was_wrong():
    with pytest.raises(ValueError, match="expected a code, 2 finite numbers"):
        nearest_equilibrium(pendulum(), np.array([0.0, np.nan]))
    with pytest.raises(ValueError, match="u_min <= u_max"):
        nearest_equilibrium(pendulum(), np.zeros(2), 1.0, -1.0)
