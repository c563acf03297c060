"""The differentiable fit: against the dense formula, and its gradient against differences."""

import numpy as np
import torch

from koop_service.learning.fit import proximal_solve, regressors, roll_out


def linear_system(seed: int, frames: int, n: int = 3, p: int = 1):
    """Codes and controls of a stable linear system with history 2 and a constant."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(n, 2 * n + p + 1)) * 0.2
    codes, controls = list(rng.normal(size=(2, n))), rng.normal(size=(frames - 1, p))
    for k in range(1, frames - 1):
        w = np.concatenate([codes[k - 1], codes[k], controls[k], [1.0]])
        codes.append(theta @ w)
    return theta, torch.tensor(np.array(codes))[None], torch.tensor(controls)[None]


def test_recovers_a_linear_system():
    theta, codes, controls = linear_system(0, 60)
    W, Y = regressors(codes, controls, history=2)
    fitted = proximal_solve(W, Y, rho=1e-9, refinements=2)[0]
    np.testing.assert_allclose(fitted.numpy(), theta, atol=1e-6)


def test_equals_the_papers_iteration():
    _, codes, controls = linear_system(1, 12)
    W, Y = regressors(codes, controls, history=2)
    rho, w, y = 0.3, W[0].numpy(), Y[0].numpy()
    expected = np.zeros((w.shape[1], y.shape[1]))
    for _ in range(3):
        expected = np.linalg.solve(w.T @ w + rho * np.eye(w.shape[1]), w.T @ y + rho * expected)
    np.testing.assert_allclose(proximal_solve(W, Y, rho, 3)[0].numpy(), expected.T, atol=1e-10)


def test_gradient_against_finite_differences():
    generator = torch.Generator().manual_seed(0)
    W = torch.randn(1, 6, 4, dtype=torch.float64, generator=generator, requires_grad=True)
    Y = torch.randn(1, 6, 2, dtype=torch.float64, generator=generator, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w, y: proximal_solve(w, y, 0.1, 3), (W, Y))


def test_rolls_out_what_it_fitted():
    theta, codes, controls = linear_system(2, 40)
    history = codes[:, None, 9:11]
    future = controls[:, None, 10:30]
    ahead = roll_out(torch.tensor(theta)[None], history, future)
    np.testing.assert_allclose(ahead[0, 0].numpy(), codes[0, 11:31].numpy(), atol=1e-10)


def test_a_roll_out_is_the_steps_one_after_the_other():
    """Three restarts with a Theta each, of which some grow, and one Theta for all of them."""
    rng = np.random.default_rng(3)
    thetas = torch.tensor(rng.normal(size=(2, 3, 4, 11)) * 0.3)
    history, controls = (torch.tensor(rng.normal(size=(2, 3, k, m))) for k, m in ((2, 4), (37, 2)))
    for theta in (thetas, thetas[:, :1]):
        ahead = roll_out(theta, history, controls)
        assert ahead.shape == (2, 3, 37, 4)
        recent = [history[:, :, 0], history[:, :, 1]]
        for k in range(37):
            w = torch.cat([*recent, controls[:, :, k], torch.ones(2, 3, 1)], dim=2)
            recent = [recent[1], (theta @ w[..., None])[..., 0]]
            torch.testing.assert_close(ahead[:, :, k], recent[1], rtol=1e-9, atol=1e-9)
