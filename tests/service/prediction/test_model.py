"""The model's blocks and its companion form."""

import numpy as np
import pytest

from koop_service.estimation.settings import EstimatorSettings
from koop_service.prediction.model import LinearModel


def test_theta_is_cut_oldest_code_first():
    Theta = np.arange(2.0 * 8).reshape(2, 8)
    model = LinearModel.from_theta(Theta, EstimatorSettings(2, 3, 1, affine=True))
    np.testing.assert_array_equal(model.A, Theta[:, :6])
    np.testing.assert_array_equal(model.B, Theta[:, 6:7])
    np.testing.assert_array_equal(model.c, Theta[:, 7])
    assert (model.code_size, model.history, model.control_size) == (2, 3, 1)


def test_without_a_constant_or_controls_theta_is_all_A():
    model = LinearModel.from_theta(np.ones((2, 4)), EstimatorSettings(2, 2, 0))
    assert model.B.shape == (2, 0)
    np.testing.assert_array_equal(model.c, [0.0, 0.0])


def test_the_model_does_not_share_memory_with_theta():
    Theta = np.ones((2, 5))
    model = LinearModel.from_theta(Theta, EstimatorSettings(2, 2, 1))
    Theta[:] = 7.0
    assert model.A.max() == model.B.max() == 1.0


@pytest.mark.parametrize("history", [1, 2, 4])
def test_the_companion_form_shifts_the_history_and_adds_the_next_code(history):
    rng = np.random.default_rng(0)
    n, p = 3, 2
    model = LinearModel(
        rng.normal(size=(n, n * history)), rng.normal(size=(n, p)), rng.normal(size=n)
    )
    codes, u = rng.normal(size=(history, n)), rng.normal(size=p)
    x = codes.reshape(-1)
    after = model.companion() @ x + model.companion_input() @ u + model.companion_offset()
    newest = sum(model.A[:, i * n : (i + 1) * n] @ codes[i] for i in range(history))
    expected = np.concatenate([codes[1:].reshape(-1), newest + model.B @ u + model.c])
    np.testing.assert_allclose(after, expected, rtol=1e-14)


def test_the_spectral_radius_of_an_oscillator_is_its_damping():
    # z'' sampled: z_{t+1} = 2 r cos(a) z_t - r^2 z_{t-1} has poles r exp(+- i a).
    r, a = 0.9, 0.4
    model = LinearModel(np.array([[-(r**2), 2 * r * np.cos(a)]]), np.zeros((1, 0)), np.zeros(1))
    assert model.spectral_radius() == pytest.approx(r, rel=1e-12)


@pytest.mark.parametrize(
    ("A", "B", "c", "problem"),
    [
        (np.ones(3), np.ones((3, 1)), np.ones(3), "A has shape"),
        (np.ones((2, 3)), np.ones((2, 1)), np.ones(2), "A has shape"),
        (np.ones((2, 0)), np.ones((2, 1)), np.ones(2), "A has shape"),
        (np.ones((2, 4)), np.ones((3, 1)), np.ones(2), "B has shape"),
        (np.ones((2, 4)), np.ones(2), np.ones(2), "B has shape"),
        (np.ones((2, 4)), np.ones((2, 1)), np.ones(3), "c has shape"),
        (np.full((2, 4), np.nan), np.ones((2, 1)), np.ones(2), "A has NaN"),
        (np.ones((2, 4)), np.full((2, 1), np.inf), np.ones(2), "B has NaN or infinity"),
    ],
)
def test_blocks_that_do_not_fit_are_refused(A, B, c, problem):
    with pytest.raises(ValueError, match=problem):
        LinearModel(A, B, c)


def test_theta_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"expected \(2, 5\)"):
        LinearModel.from_theta(np.ones((2, 4)), EstimatorSettings(2, 2, 1))
