"""Dynamic programming against least squares on the simulated trajectory, and against the QP."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.control.problem import build_lqr
from koop_service.control.riccati import lqr_riccati
from koop_service.control.solve import solve_qp
from koop_service.prediction.rollout import rollout

from .systems import random_model, random_weight

SEEDS = st.integers(0, 2**32 - 1)


def by_least_squares(model, history, target, horizon, Q, R, Qf):
    """Minimise |Q^{1/2} (z - z_f)|^2 + |R^{1/2} u|^2 + |Qf^{1/2} (x_N - x_f)|^2, probed by u."""
    p, h = model.control_size, model.history
    q, r, f = (np.linalg.cholesky(weight).T for weight in (Q, R, Qf))

    def residual(u):
        u = u.reshape(horizon, p)
        codes = rollout(model, history, u)
        error = (codes - target)[:-1]
        last = (np.concatenate([history, codes])[-h:] - np.atleast_2d(target)[-1]).reshape(-1)
        return np.concatenate([(error @ q.T).reshape(-1), (u @ r.T).reshape(-1), f @ last])

    offset = residual(np.zeros(horizon * p))
    columns = [residual(unit) - offset for unit in np.eye(horizon * p)]
    return np.linalg.lstsq(np.array(columns).T, -offset, rcond=None)[0].reshape(horizon, p)


@settings(deadline=None)
@given(
    SEEDS,
    st.integers(1, 5),
    st.integers(1, 3),
    st.integers(1, 3),
    st.integers(1, 12),
    st.booleans(),
)
def test_it_and_the_qp_equal_least_squares(seed, n, h, p, horizon, affine):
    rng = np.random.default_rng(seed)
    model = random_model(rng, n, h, p, affine=affine)
    history = rng.normal(size=(h, n))
    target = rng.normal(size=(horizon, n)) if seed % 2 else rng.normal(size=n)
    Q, R, Qf = random_weight(rng, n), random_weight(rng, p), random_weight(rng, h * n)
    expected = by_least_squares(model, history, target, horizon, Q, R, Qf)
    u = lqr_riccati(model, history, target, horizon, Q, R, Qf=Qf)
    qp = build_lqr(model, history, target, horizon, Q, R, Qf=Qf)
    for found in (u, solve_qp(qp).u):
        np.testing.assert_allclose(found, expected, atol=1e-8 * (1 + np.abs(expected).max()))


@settings(deadline=None, max_examples=50)
@given(SEEDS, st.integers(1, 2), st.sampled_from([10, 40]), st.sampled_from([0.9, 1.0, 1.1]))
def test_equals_the_qp_where_no_bound_is_active(seed, p, horizon, radius):
    rng = np.random.default_rng(seed)
    model = random_model(rng, p=p, radius=radius)
    history, target = rng.normal(size=(2, 8)), rng.normal(size=8)
    arguments = (model, history, target, horizon, 1.0, 0.1)
    u = lqr_riccati(*arguments, Qf="riccati")
    wide = 1.1 * np.abs(u).max()
    for bound in (None, wide):
        low = None if bound is None else -bound
        solution = solve_qp(build_lqr(*arguments, low, bound, Qf="riccati"))
        assert solution.status == "solved"
        np.testing.assert_allclose(solution.u, u, atol=1e-6)


def test_the_target_is_reached_and_held_where_it_is_an_equilibrium():
    rng = np.random.default_rng(1)
    model = random_model(rng, n=2, h=2, p=2, radius=1.05)
    # With as many controls as codes every target can be held.
    target = np.array([0.7, -0.4])
    history = rng.normal(size=(2, 2))
    codes = rollout(model, history, lqr_riccati(model, history, target, 30, 1.0, 1e-8))
    np.testing.assert_allclose(codes[2:], np.tile(target, (28, 1)), atol=1e-5)


def test_bad_arguments_are_refused_as_for_the_qp():
    model = random_model(np.random.default_rng(0))
    with pytest.raises(ValueError, match="horizon is 0"):
        lqr_riccati(model, np.zeros((2, 8)), np.zeros(8), 0, 1, 1)
    with pytest.raises(ValueError, match="R is not positive definite"):
        lqr_riccati(model, np.zeros((2, 8)), np.zeros(8), 5, 1, -1)
