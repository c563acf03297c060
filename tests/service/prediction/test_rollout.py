"""The roll-out against powers of the companion form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import affine_response, impulse_response, regressors, rollout


def random_model(rng, n, h, p):
    model = LinearModel(rng.normal(size=(n, n * h)), rng.normal(size=(n, p)), rng.normal(size=n))
    # Scaling block i by r^(h-i) scales every pole by r.
    scale = np.repeat((1.0 / model.spectral_radius()) ** np.arange(h, 0, -1), n)
    return LinearModel(model.A * scale, model.B, model.c)


def through_companion(model, history, controls):
    x, codes = history.reshape(-1), []
    for u in controls:
        x = model.companion() @ x + model.companion_input() @ u + model.companion_offset()
        codes.append(x[-model.code_size :])
    return np.array(codes)


@settings(deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 5),
    st.integers(1, 3),
    st.integers(0, 2),
    st.integers(1, 9),
)
def test_equals_the_companion_form(seed, n, h, p, horizon):
    rng = np.random.default_rng(seed)
    model = random_model(rng, n, h, p)
    history, controls = rng.normal(size=(h, n)), rng.normal(size=(horizon, p))
    expected = through_companion(model, history, controls)
    codes = rollout(model, history, controls)
    np.testing.assert_allclose(codes, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 3), st.integers(1, 2))
def test_regressors_reproduce_the_codes(seed, n, h, p):
    rng = np.random.default_rng(seed)
    model = random_model(rng, n, h, p)
    history, controls = rng.normal(size=(h, n)), rng.normal(size=(7, p))
    codes = rollout(model, history, controls)
    W = regressors(history, codes, controls)
    Theta = np.hstack([model.A, model.B])
    np.testing.assert_allclose(W @ Theta.T + model.c, codes, rtol=1e-9, atol=1e-9)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 3), st.integers(0, 2))
def test_the_affine_response_sums_to_the_roll_out(seed, n, h, p):
    rng = np.random.default_rng(seed)
    model = random_model(rng, n, h, p)
    history, controls = rng.normal(size=(h, n)), rng.normal(size=(6, p))
    codes, markov = affine_response(model, history, 6)
    for s, u in enumerate(controls):
        codes[s:] += (markov @ u)[: 6 - s]
    expected = rollout(model, history, controls)
    np.testing.assert_allclose(codes, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_the_impulse_response_is_what_a_control_adds():
    rng = np.random.default_rng(3)
    model = random_model(rng, 4, 2, 2)
    history, controls = rng.normal(size=(2, 4)), rng.normal(size=(6, 2))
    pushed = controls.copy()
    pushed[2, 1] += 1.0
    added = rollout(model, history, pushed) - rollout(model, history, controls)
    markov = impulse_response(model, model.B, 6)
    np.testing.assert_array_equal(added[:2], 0.0)
    np.testing.assert_allclose(added[2:], markov[:4, :, 1], rtol=1e-10, atol=1e-12)


def test_arguments_are_left_alone():
    rng = np.random.default_rng(4)
    model = random_model(rng, 2, 2, 1)
    history, controls = np.ones((2, 2)), np.ones((3, 1))
    codes = rollout(model, history, controls)
    codes[:] = 9.0
    np.testing.assert_array_equal(history, 1.0)
    np.testing.assert_array_equal(controls, 1.0)


@pytest.mark.filterwarnings("error")
def test_an_unstable_model_overflows_without_raising():
    model = LinearModel(np.array([[1e200]]), np.zeros((1, 0)), np.zeros(1))
    codes = rollout(model, np.ones((1, 1)), np.zeros((4, 0)))
    assert np.isfinite(codes[0]).all()
    assert not np.isfinite(codes[-1]).any()


@pytest.mark.parametrize(
    ("history", "controls", "problem"),
    [
        (np.ones((1, 3)), np.ones((4, 2)), "history has shape"),
        (np.ones((2, 2)), np.ones((4, 2)), "history has shape"),
        (np.full((2, 3), np.nan), np.ones((4, 2)), "history has NaN"),
        (np.ones((2, 3)), np.ones((4, 1)), "controls has shape"),
        (np.ones((2, 3)), np.ones(4), "controls has shape"),
        (np.ones((2, 3)), np.full((4, 2), np.inf), "controls has NaN or infinity"),
        (np.ones((2, 3)), np.ones((0, 2)), "horizon"),
        (np.ones((2, 3)), np.array(1.0), "horizon"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(history, controls, problem):
    model = random_model(np.random.default_rng(0), 3, 2, 2)
    with pytest.raises(ValueError, match=problem):
        rollout(model, history, controls)
