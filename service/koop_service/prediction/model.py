"""The estimated linear model and its companion form (eq. 9 to 11)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koop_service.estimation.settings import EstimatorSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """z_{t+1} = A [z_{t-h+1}; ...; z_t] + B u_t + c, in code space (eq. 9 and 11).

    A: (n, h*n) = [A_1 ... A_h], oldest code first.
    B: (n, p); p = 0 when unforced.
    c: (n,); zero unless the estimator is affine.
    Raises ValueError for shapes that do not fit together and for NaN or infinity.
    """

    A: Array
    B: Array
    c: Array

    def __post_init__(self) -> None:
        n = self.A.shape[0] if self.A.ndim == 2 else 0
        if n == 0 or self.A.shape[1] == 0 or self.A.shape[1] % n:
            raise ValueError(f"A has shape {self.A.shape}; expected (n, h*n): a row block of codes")
        if self.B.ndim != 2 or self.B.shape[0] != n:
            raise ValueError(f"B has shape {self.B.shape}; expected ({n}, p), p = 0 when unforced")
        if self.c.shape != (n,):
            raise ValueError(f"c has shape {self.c.shape}; expected ({n},), zero when not affine")
        for name, array in (("A", self.A), ("B", self.B), ("c", self.c)):
            if not np.isfinite(array).all():
                raise ValueError(f"{name} has NaN or infinity; expected finite numbers")

    @classmethod
    def from_theta(cls, Theta: Array, settings: EstimatorSettings) -> "LinearModel":
        """Cut Theta = [A_1 ... A_h B c?], (n, d), into its blocks."""
        n, p, d = settings.code_size, settings.control_size, settings.regressor_size
        if Theta.shape != (n, d):
            raise ValueError(f"Theta has shape {Theta.shape}; expected {(n, d)} by the settings")
        hn = settings.history * n
        c = Theta[:, -1].copy() if settings.affine else np.zeros(n)
        return cls(Theta[:, :hn].copy(), Theta[:, hn : hn + p].copy(), c)

    @property
    def code_size(self) -> int:
        """n, numbers in a code."""
        return self.A.shape[0]

    @property
    def history(self) -> int:
        """h, codes that the next one depends on."""
        return self.A.shape[1] // self.A.shape[0]

    @property
    def control_size(self) -> int:
        """p, numbers in a control."""
        return self.B.shape[1]

    def companion(self) -> Array:
        """F (hn, hn) of x_{t+1} = F x_t + G u_t + f with x_t = [z_{t-h+1}; ...; z_t] (eq. 10)."""
        n, hn = self.A.shape
        F = np.zeros((hn, hn))
        F[:-n] = np.eye(hn)[n:]
        F[-n:] = self.A
        return F

    def companion_input(self) -> Array:
        """G (hn, p): a control enters the newest code only."""
        G = np.zeros((self.A.shape[1], self.control_size))
        G[-self.code_size :] = self.B
        return G

    def companion_offset(self) -> Array:
        """f (hn,): so does the constant."""
        f = np.zeros(self.A.shape[1])
        f[-self.code_size :] = self.c
        return f

    def spectral_radius(self) -> float:
        """Largest eigenvalue modulus of F: above 1, an unforced roll-out grows without bound."""
        return float(np.abs(np.linalg.eigvals(self.companion())).max())
