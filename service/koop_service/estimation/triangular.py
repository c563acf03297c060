"""Solves with an upper triangular factor, in place, for several right-hand sides at once."""

from .compiled import Array, compiled


@compiled
def back_substitute(R: Array, X: Array) -> None:
    """X <- R^{-1} X, with X (d, m) and R (d or more, d or more); reads R's upper triangle only."""
    d = X.shape[0]
    for i in range(d - 1, -1, -1):
        x = X[i]
        for j in range(i + 1, d):
            _subtract(x, R[i, j], X[j])
        _divide(x, R[i, i])


@compiled
def forward_substitute(R: Array, X: Array) -> None:
    """X <- R^{-T} X, with X (d, m) and R (d or more, d or more); reads R's upper triangle only."""
    d = X.shape[0]
    for i in range(d):
        x = X[i]
        for j in range(i):
            _subtract(x, R[j, i], X[j])
        _divide(x, R[i, i])


@compiled
def _subtract(x: Array, factor: float, other: Array) -> None:
    for k in range(x.shape[0]):
        x[k] -= factor * other[k]


@compiled
def _divide(x: Array, divisor: float) -> None:
    for k in range(x.shape[0]):
        x[k] /= divisor
