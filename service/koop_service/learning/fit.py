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
    solution = torch.cholesky_solve(right, factor)
    for _ in range(refinements - 1):
        solution = torch.cholesky_solve(right + rho * solution, factor)
    return solution.mT


def roll_out(theta: Tensor, history: Tensor, controls: Tensor) -> Tensor:
    """Codes (B, S, K, n) from S restarts a trajectory.

    theta (B, S, n, d), or (B, 1, n, d) for all restarts; history (B, S, h, n), oldest first;
    controls (B, S, K, p).
    """
    transposed = theta.to(history.dtype).mT
    recent = list(history.unbind(2))
    constant = torch.ones_like(history[:, :, 0, :1])
    codes = []
    for control in controls.unbind(2):
        regressor = torch.cat([*recent, control, constant], dim=2)
        recent.append((regressor[:, :, None] @ transposed)[:, :, 0])
        codes.append(recent[-1])
        del recent[0]
    return torch.stack(codes, dim=2)
