"""Weights of a quadratic cost as they travel: a number, a diagonal or a matrix."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from koop_protocol import checks
from koop_protocol.errors import ErrorCode, ProtocolError

Weights = float | NDArray[np.float64]
"""A number (times the identity), a diagonal (size,) or a symmetric matrix (size, size)."""

# A matrix product of the sender's, such as C^T C, is symmetric and semidefinite to rounding only.
_ROUNDING = 1e-9


def check_weights(field: str, value: object, max_size: int, definite: bool) -> Weights:
    """The weights as float or float64 array if they are positive (semi)definite.

    Args:
        field: name for the error.
        value: a number, (size,) diagonal or (size, size) matrix.
        max_size: largest size.
        definite: True asks for positive definite, False for positive semidefinite.

    Raises:
        ProtocolError: wrong_type, wrong_shape, wrong_dtype, too_large, not_finite, bad_weights.
    """
    if not isinstance(value, np.ndarray):
        number = checks.real(field, value)
        if number < 0 or (definite and number == 0):
            raise _bad(field, f"is {number}", definite)
        return number
    array = cast("NDArray[np.generic]", value)
    if array.ndim == 1:
        diagonal = checks.vector(field, array, max_size)
        if (diagonal < 0).any() or (definite and not diagonal.all()):
            raise _bad(field, f"has the diagonal entry {diagonal.min()}", definite)
        return diagonal
    matrix = np.asarray(checks.table(field, array, max_size, max_size), np.float64)
    _check_matrix(field, matrix, definite)
    return matrix


def check_sizes(code: ErrorCode, **parts: Weights | str | None) -> None:
    """Check that all given vectors, matrices and rows are of the same number of components."""
    sizes = {name: part.shape[-1] for name, part in parts.items() if isinstance(part, np.ndarray)}
    if len(set(sizes.values())) > 1:
        raise ProtocolError(
            code,
            f"the sizes differ: {', '.join(f'{name} {size}' for name, size in sizes.items())}",
            "one size for all of them",
            details=sizes,
        )


def _check_matrix(field: str, matrix: NDArray[np.float64], definite: bool) -> None:
    if matrix.shape[0] != matrix.shape[1]:
        raise checks.fault(
            ErrorCode.wrong_shape,
            field,
            f"has shape {matrix.shape}",
            "a number, a diagonal (size,) or a square matrix (size, size)",
        )
    scale = float(np.abs(matrix).max())
    if scale == 0.0:
        if definite:
            raise _bad(field, "is zero", definite)
        return
    unit = matrix / scale
    if np.abs(unit - unit.T).max() > _ROUNDING:
        raise _bad(field, "is not symmetric", definite)
    smallest = _smallest_eigenvalue(unit)
    if smallest < -_ROUNDING or (definite and smallest <= 0.0):
        raise _bad(field, f"has the eigenvalue {smallest * scale:.3g}", definite)


def _smallest_eigenvalue(matrix: NDArray[np.float64]) -> float:
    try:
        return float(np.linalg.eigvalsh(matrix)[0])
    except np.linalg.LinAlgError:
        return -np.inf


def _bad(field: str, problem: str, definite: bool) -> ProtocolError:
    kind = "definite" if definite else "semidefinite"
    return checks.fault(
        ErrorCode.bad_weights, field, problem, f"a symmetric positive {kind} weight"
    )
