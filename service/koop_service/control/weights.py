"""What the codes' and the controls' deviations cost (Q and R of eq. 13)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Relative to the largest eigenvalue: below these an eigenvalue is a zero up to rounding.
_DEFINITE = 1e-14
_SEMIDEFINITE = 1e-12


@dataclass(frozen=True, eq=False)
class LqrWeights:
    """Q (n, n) symmetric positive semidefinite, R (p, p) symmetric positive definite."""

    Q: Array
    R: Array

    @classmethod
    def parse(cls, Q: ArrayLike, R: ArrayLike, code_size: int, control_size: int) -> "LqrWeights":
        """From numbers (times the identity), vectors (diagonals) or matrices.

        Raises ValueError unless they are finite, symmetric and definite enough.
        """
        return cls(
            _matrix("Q", Q, code_size, definite=False), _matrix("R", R, control_size, definite=True)
        )


def _matrix(name: str, value: ArrayLike, size: int, *, definite: bool) -> Array:
    weight = np.asarray(value, dtype=np.float64)
    if weight.shape not in ((), (size,), (size, size)):
        raise ValueError(
            f"{name} has shape {weight.shape}; expected a number, ({size},) or ({size}, {size})"
        )
    if not np.isfinite(weight).all():
        raise ValueError(f"{name} has NaN or infinity; expected finite numbers")
    if definite:
        _require_definite(name, _eigenvalues(name, weight))
    else:
        _require_semidefinite(name, _eigenvalues(name, weight))
    return weight if weight.ndim == 2 else np.diag(np.broadcast_to(weight, (size,)))


def _eigenvalues(name: str, weight: Array) -> Array:
    if weight.ndim < 2:
        return weight.reshape(-1)
    if np.abs(weight - weight.T).max() > 1e-9 * np.abs(weight).max():
        raise ValueError(f"{name} is not symmetric; expected {name} = {name}^T: send (W + W^T) / 2")
    return np.asarray(np.linalg.eigvalsh(weight), dtype=np.float64)


def _require_definite(name: str, eigenvalues: Array) -> None:
    if eigenvalues.min() <= _DEFINITE * np.abs(eigenvalues).max():
        raise ValueError(
            f"{name} is not positive definite (lowest eigenvalue {eigenvalues.min():.3g}); expected"
            " every direction of the control to cost something: add a small diagonal"
        )


def _require_semidefinite(name: str, eigenvalues: Array) -> None:
    if eigenvalues.min() < -_SEMIDEFINITE * np.abs(eigenvalues).max():
        raise ValueError(
            f"{name} is not positive semidefinite (lowest eigenvalue {eigenvalues.min():.3g});"
            " expected no direction of the code to earn a reward"
        )
