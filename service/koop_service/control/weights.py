"""What the codes' and the controls' deviations cost (Q and R of eq. 13), and the end (Qf)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_service.prediction.model import LinearModel

from .stationary import state_weight, stationary_cost

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


def terminal_weight(
    model: LinearModel, weights: LqrWeights, Qf: ArrayLike | Literal["riccati"] | None = None
) -> Array:
    """The last step's weight (hn, hn), on the deviation of x_N from rest at the target.

    None: Q on the last code as on any other, the paper's eq. 13. "riccati": what going on for ever
    costs (`stationary_cost`), where a control can make the model stable, else as for None. A
    number, (n,) or (n, n) is a weight on the last code, (hn, hn) one on the last h codes. Raises
    ValueError as for Q.

    "riccati" takes about as long as the QP: whoever plans at every frame may keep it for some.
    """
    if isinstance(Qf, str):
        if Qf != "riccati":
            raise ValueError(f'Qf is {Qf!r}; expected "riccati", a weight or None')
        cost = stationary_cost(model, weights.Q, weights.R)
        return state_weight(model, weights.Q) if cost is None else cost
    n, hn = model.A.shape
    if Qf is not None and np.shape(Qf) == (hn, hn):
        return _matrix("Qf", Qf, hn, definite=False)
    last = weights.Q if Qf is None else _matrix("Qf", Qf, n, definite=False)
    return state_weight(model, last)


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
