"""Whether a target can be held at rest."""

import numpy as np

from koop_service.control.equilibrium import resting_control
from koop_service.prediction.rollout import rollout

from .systems import random_model


def test_with_as_many_controls_as_codes_every_target_can_be_held():
    model = random_model(np.random.default_rng(0), n=2, h=3, p=2)
    target = np.array([0.3, -2.0])
    u, drift = resting_control(model, target)
    np.testing.assert_allclose(drift, 0.0, atol=1e-12)
    codes = rollout(model, np.tile(target, (3, 1)), np.tile(u, (5, 1)))
    np.testing.assert_allclose(codes, np.tile(target, (5, 1)), atol=1e-10)


def test_the_drift_is_the_next_code_less_the_target_and_no_control_makes_it_smaller():
    rng = np.random.default_rng(1)
    model, target = random_model(rng), rng.normal(size=8)
    u, drift = resting_control(model, target)
    history = np.tile(target, (2, 1))
    np.testing.assert_allclose(rollout(model, history, u[None])[0] - target, drift, atol=1e-12)
    for _ in range(20):
        other = rollout(model, history, u[None] + rng.normal(size=(1, 1)))[0] - target
        assert np.linalg.norm(other) > np.linalg.norm(drift)
