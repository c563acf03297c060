"""What is fitted to each trajectory and what is learned for all: ours, and the two baselines.

- fitted: Theta is the proximal fit to each trajectory (eq. 5 to 7, 11); nothing is learned, or,
  with `around_mean`, the Theta that the fit's prior is centred on.
- learned-A: one Theta for all trajectories, a parameter like the network's ([17] of the paper).
- learned-B: the columns of Theta that act on the controls are a parameter, the others are fitted
  to what the controls leave ([6]).

All give Theta (B, n, d) from W (B, K, d) and Y (B, K, n), so the rest of training is one code path.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor, nn

from koop_service.encoding.weights import DYNAMICS_TENSOR, FITTED, load_card
from koop_service.learning.fit import proximal_solve

KINDS = (FITTED, "learned-A", "learned-B")


@dataclass(frozen=True)
class Sizes:
    """Code size n, history h, control size p; a regressor has d = h n + p + 1 numbers."""

    code: int
    history: int
    control: int

    @property
    def regressor(self) -> int:
        return self.history * self.code + self.control + 1

    @property
    def controls(self) -> slice:
        """The columns of Theta that act on the controls."""
        first = self.history * self.code
        return slice(first, first + self.control)


class Dynamics(nn.Module):
    """One of KINDS; `matrix` is what is learned: (n, d) of learned-A, (n, p) of learned-B.

    rho: weight of the fit's prior. around_mean: where it is not 0, FITTED learns the prior's mean
    (n, d) too, and this is the weight around it.
    """

    def __init__(
        self, kind: str, sizes: Sizes, rho: float, refinements: int, around_mean: float = 0.0
    ) -> None:
        super().__init__()
        if kind == "learned-B" and not sizes.control:
            raise ValueError(
                "dynamics learned-B learns how controls act, and the recording has none; "
                "record an actuated system, or train with --dynamics learned-A"
            )
        self.kind, self.sizes = kind, sizes
        centred = kind == FITTED and around_mean > 0
        self.rho, self.refinements = around_mean if centred else rho, refinements
        mean = sizes.regressor if centred else 0
        columns = {FITTED: mean, "learned-A": sizes.regressor, "learned-B": sizes.control}[kind]
        self.matrix = nn.Parameter(torch.zeros(sizes.code, columns)) if columns else None

    @property
    def is_blank(self) -> bool:
        """Whether there is something to learn that no step and no start has touched."""
        return self.matrix is not None and not self.matrix.any()

    @torch.no_grad()
    def go_on_from(self, matrix: Tensor | None) -> None:
        """Start what is learned at what was learned before, where that is of the same kind."""
        if matrix is not None and self.matrix is not None and matrix.shape == self.matrix.shape:
            self.matrix.copy_(matrix)

    def initialise(self, W: Tensor, Y: Tensor) -> None:
        """Start what is learned at the least squares of all trajectories of a batch together."""
        if self.matrix is None:
            return
        pooled = self._fit(W.flatten(0, 1)[None], Y.flatten(0, 1)[None])[0]
        start = pooled[:, self.sizes.controls] if self.kind == "learned-B" else pooled
        with torch.no_grad():
            self.matrix.copy_(start)

    def forward(self, W: Tensor, Y: Tensor) -> Tensor:
        """Theta (B, n, d) in float64."""
        if self.matrix is None:
            return self._fit(W, Y)
        learned = self.matrix.double().expand(len(W), -1, -1)
        if self.kind == "learned-A":
            return learned
        if self.kind == FITTED:
            return learned + self._fit(W, Y.double() - W.double() @ learned.mT)
        return self._fit_around(learned, W, Y)

    def _fit(self, W: Tensor, Y: Tensor) -> Tensor:
        return proximal_solve(W, Y, self.rho, self.refinements)

    def _fit_around(self, B: Tensor, W: Tensor, Y: Tensor) -> Tensor:
        """The columns beside B are fitted to Y - U B^T."""
        acting = self.sizes.controls
        others = torch.cat([W[..., : acting.start], W[..., acting.stop :]], dim=2)
        rest = self._fit(others, Y.double() - W[..., acting].double() @ B.mT)
        return torch.cat([rest[..., : acting.start], B, rest[..., acting.start :]], dim=2)


@dataclass(frozen=True, eq=False)
class LearnedDynamics:
    """`kind` "learned-A": `matrix` (n, d) over [z_{t-h+1}; ...; z_t; u_t; 1]; "learned-B": (n, p).

    `matrix` is float64.
    """

    kind: str
    matrix: np.ndarray


def load_learned(path: Path) -> LearnedDynamics | None:
    """The learned dynamics in a weights file; None where they are fitted to each trajectory."""
    kind = load_card(path).dynamics
    if kind == FITTED:
        return None
    with safe_open(path, "pt") as file:
        if DYNAMICS_TENSOR not in file.keys():  # noqa: SIM118
            raise ValueError(
                f"{path} says that its dynamics are {kind}, but holds no {DYNAMICS_TENSOR!r}; "
                f"train it again with koop-train --dynamics {kind}"
            )
        return LearnedDynamics(kind, file.get_tensor(DYNAMICS_TENSOR).double().numpy())
