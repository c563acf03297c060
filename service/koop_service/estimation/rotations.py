"""One row into (Givens) or out of (hyperbolic) the square-root factor [R D].

Both take `rows`, whose first d rows are [R D] (d, d + n), R upper triangular with a positive
diagonal; what follows them is not touched.
"""

import math

from .compiled import Array, compiled

#: Share of a squared pivot that a downdate must leave, so that half the digits survive it.
LEAST_LEFT = 1e-8


@compiled
def rotate(rows: Array, x: Array, first: int, d: int, decay: float) -> None:
    """Givens: R^T R <- decay^2 R^T R + x x^T; x (d + n,) ends as [.. e^T].

    x must be zero before column `first`; rows before it are not touched (nor decayed). The next
    pivot is formed ahead of the row's loop: square root and divisions are the critical path.
    Adding 0.0 turns -0.0 into 0.0, so that rotating a row of zeros leaves every bit as it is,
    which the batched kernel relies on.
    """
    b = x[first]
    for i in range(first, d):
        a = decay * rows[i, i]
        r = math.sqrt(a * a + b * b)
        c = a / r
        s = b / r
        rows[i, i] = r
        row, rest = rows[i, i + 1 :], x[i + 1 :]
        b = c * rest[0] - s * (decay * row[0])
        for j in range(row.shape[0]):
            t = decay * row[j]
            v = rest[j]
            row[j] = (c * t + s * v) + 0.0
            rest[j] = c * v - s * t


@compiled
def rotate_out(rows: Array, x: Array, d: int) -> bool:
    """Hyperbolic downdate: R^T R <- R^T R - x x^T, in the mixed form (the new R cleans x).

    False when what would be left is not positive definite, or too little of it to trust
    (LEAST_LEFT); `rows` is then spoilt and must be rebuilt.
    """
    for i in range(d):
        a = rows[i, i]
        b = x[i]
        left = (a - b) * (a + b)
        if not left > LEAST_LEFT * a * a:
            return False
        r = math.sqrt(left)
        c = r / a
        s = b / a
        rows[i, i] = r
        row, rest = rows[i, i + 1 :], x[i + 1 :]
        for j in range(row.shape[0]):
            t = (row[j] - s * rest[j]) / c
            row[j] = t + 0.0
            rest[j] = c * rest[j] - s * t
    return True
