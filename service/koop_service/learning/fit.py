"""Eq. 5 to 11 inside the training graph: the differentiable fit, and its roll-out.

The solve is float64 whatever the network runs in. `h` codes of size n, p controls and a constant
make a regressor of d = h n + p + 1 numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor


def regressors(codes: Tensor, controls: Tensor, history: int) -> tuple[Tensor, Tensor]:
    """W (B, K, d) and Y (B, K, n) of codes (B, m, n) and controls (B, m-1, p); K = m - h."""
    m = codes.shape[1]
    past = [codes[:, i : m - history + i] for i in range(history)]
    acting = controls[:, history - 1 : m - 1]
    constant = torch.ones_like(codes[:, history:, :1])
    return torch.cat([*past, acting, constant], dim=2), codes[:, history:]


def proximal_solve(W: Tensor, Y: Tensor, rho: float, refinements: int) -> Tensor:
    """Theta (B, n, d) of eq. 7's proximal iteration, in float64, by Cholesky of W^T W + rho I."""
    W, Y = W.double(), Y.double()
    identity = torch.eye(W.shape[2], dtype=W.dtype, device=W.device)
    factor = torch.linalg.cholesky(W.mT @ W + rho * identity)
    right = W.mT @ Y
    solution = _solved(factor, right)
    for _ in range(refinements - 1):
        solution = _solved(factor, right + rho * solution)
    return solution.mT


def _solved(factor: Tensor, right: Tensor) -> Tensor:
    """By two triangular solves: torch.cholesky_solve takes a batch one by one on a GPU."""
    half = torch.linalg.solve_triangular(factor, right, upper=False)
    return torch.linalg.solve_triangular(factor.mT, half, upper=True)


def roll_out(theta: Tensor, history: Tensor, controls: Tensor) -> Tensor:
    """Codes (B, S, K, n) from S restarts a trajectory.

    theta (B, S, n, d), or (B, 1, n, d) for all restarts; history (B, S, h, n), oldest first;
    controls (B, S, K, p).

    The steps are not taken one after the other, which are thousands of small operations: x_k is
    sum_i A^(k-i) q_i of the pushes q, and sums over windows of 1, 2, 4, ... steps double by
    themselves.
    """
    theta, n = theta.to(history.dtype), history.shape[3]
    power = _companion(theta[..., : history.shape[2] * n]).mT
    constant = controls.new_ones((*controls.shape[:-1], 1))
    pushes = torch.cat([controls, constant], dim=3) @ theta[..., power.shape[-1] :].mT
    sums = torch.nn.functional.pad(pushes, (power.shape[-1] - n, 0))
    first = sums[:, :, :1] + history.flatten(2)[:, :, None] @ power
    sums = torch.cat([first, sums[:, :, 1:]], dim=2)
    width = 1
    while width < controls.shape[2]:
        power = power if width == 1 else power @ power
        later = sums[:, :, width:] + sums[:, :, :-width] @ power
        sums = torch.cat([sums[:, :, :width], later], dim=2)
        width *= 2
    return sums[..., -n:]


def _companion(past: Tensor) -> Tensor:
    """The matrix (..., h n, h n) that takes a history to the next one, of `past` (..., n, h n)."""
    n, size = past.shape[-2:]
    shift = torch.eye(size, dtype=past.dtype, device=past.device)[n:]
    return torch.cat([shift.expand(*past.shape[:-2], size - n, size), past], dim=-2)
