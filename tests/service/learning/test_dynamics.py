"""The three kinds of dynamics: what each fits, what each learns, and what is stored."""

import numpy as np
import pytest
import torch

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.weights import ModelCard, load_weights, save_weights
from koop_service.learning.dynamics import Dynamics, Sizes, load_learned
from koop_service.learning.fit import proximal_solve

SIZES = Sizes(code=3, history=2, control=1)


def measurements(windows: int = 4, noise: float = 0.0):
    """W (B, K, d), Y (B, K, n) and the Theta (n, d) that made them."""
    rng = np.random.default_rng(0)
    theta = rng.normal(size=(SIZES.code, SIZES.regressor))
    W = rng.normal(size=(windows, 30, SIZES.regressor))
    W[..., -1] = 1
    Y = W @ theta.T + noise * rng.normal(size=(windows, 30, SIZES.code))
    return torch.tensor(W), torch.tensor(Y), torch.tensor(theta)


def test_fitted_is_the_proximal_solve_of_each_window():
    W, Y, _ = measurements(noise=1.0)
    found = Dynamics("fitted", SIZES, 1e-2, 2)(W, Y)
    torch.testing.assert_close(found, proximal_solve(W, Y, 1e-2, 2))
    assert not list(Dynamics("fitted", SIZES, 1e-2, 2).parameters())


def test_a_centred_fit_is_one_to_what_the_learned_mean_leaves():
    W, Y, theta = measurements()
    dynamics = Dynamics("fitted", SIZES, 1e-2, 2, around_mean=10.0)
    assert not torch.allclose(dynamics(W, Y), theta.expand(len(W), -1, -1), atol=1e-2)
    dynamics.initialise(W, Y)
    mean = dynamics.matrix.detach().double()
    torch.testing.assert_close(dynamics(W, Y), theta.expand(len(W), -1, -1), atol=2e-2, rtol=0)
    more = Y + torch.randn(Y.shape, generator=torch.Generator().manual_seed(0))
    left = proximal_solve(W, more - W @ mean.mT, 10.0, 2)
    torch.testing.assert_close(dynamics(W, more), mean + left)


def test_learned_a_is_one_matrix_whatever_the_data():
    W, Y, theta = measurements()
    dynamics = Dynamics("learned-A", SIZES, 1e-8, 2)
    dynamics.initialise(W, Y)
    found = dynamics(torch.randn(5, 9, SIZES.regressor), torch.randn(5, 9, 3))
    assert found.shape == (5, *theta.shape)
    torch.testing.assert_close(found[3], theta, atol=1e-5, rtol=1e-5)


def test_learned_b_is_kept_and_the_rest_is_fitted_around_it():
    W, Y, theta = measurements()
    dynamics = Dynamics("learned-B", SIZES, 1e-8, 2)
    dynamics.initialise(W, Y)
    torch.testing.assert_close(dynamics(W, Y)[0], theta, atol=1e-5, rtol=1e-5)
    with torch.no_grad():
        dynamics.matrix += 1
    found = dynamics(W, Y)[1]
    torch.testing.assert_close(found[:, SIZES.controls], theta[:, SIZES.controls] + 1)
    aimed = Y[1] - W[1][:, SIZES.controls] @ found[:, SIZES.controls].T
    others = [
        i for i in range(SIZES.regressor) if not SIZES.controls.start <= i < SIZES.controls.stop
    ]
    expected = torch.linalg.lstsq(W[1][:, others], aimed).solution.T
    torch.testing.assert_close(found[:, others], expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", ["fitted", "learned-A", "learned-B"])
def test_the_gradient_reaches_what_is_learned(kind):
    W, Y, _ = measurements()
    dynamics = Dynamics(kind, SIZES, 1e-3, 2, around_mean=1.0)
    assert dynamics.rho == (1.0 if kind == "fitted" else 1e-3)
    dynamics(W, Y).square().sum().backward()
    Y.requires_grad_()
    dynamics(W, Y + 1).sum().backward()
    assert dynamics.matrix.grad.abs().sum() > 0


def test_learned_b_needs_controls():
    with pytest.raises(ValueError, match="the recording has none"):
        Dynamics("learned-B", Sizes(3, 2, 0), 1e-3, 2)


def test_what_is_learned_is_stored_beside_the_weights(tmp_path):
    path, matrix = tmp_path / "b.safetensors", torch.randn(8, 18)
    card = ModelCard(system="s", renderer="r", dt=0.05, dynamics="learned-A")
    save_weights(path, initialised(8, 0), card, matrix)
    learned = load_learned(path)
    assert learned is not None
    assert learned.kind == "learned-A"
    assert learned.matrix.dtype == np.float64
    np.testing.assert_array_equal(learned.matrix, matrix.double().numpy())
    model, loaded = load_weights(path)
    assert loaded == card
    assert torch.equal(
        model.state_dict()["encoder.0.0.weight"], initialised(8, 0).encoder[0][0].weight
    )


def test_fitted_dynamics_have_nothing_stored(tmp_path):
    path = tmp_path / "ours.safetensors"
    save_weights(path, initialised(8, 0), ModelCard(system="s", renderer="r", dt=0.05))
    assert load_learned(path) is None


def test_a_baseline_without_its_matrix_is_not_written(tmp_path):
    card = ModelCard(system="s", renderer="r", dt=0.05, dynamics="learned-B")
    with pytest.raises(ValueError, match="do not go together"):
        save_weights(tmp_path / "x.safetensors", initialised(8, 0), card)
