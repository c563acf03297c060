"""Proximal solve: from the factor to Theta, iterating the paper's eq. 7 in its primal form.

Eliminating the multipliers from eq. 7 leaves, from the prior's mean Theta_0 (the paper's is 0),

    R^T R Theta_k^T = W Y^T + rho Theta_{k-1}^T,
    R^T R = W W^T + rho I,  R^T D = W Y^T + rho Theta_0^T.

Theta_1 is ridge regression; the fixed point is the least-squares solution nearest to Theta_0 (from
0, that of minimum norm), also where W is singular. It is computed in differences,
Theta_{k+1} - Theta_k = rho (R^T R)^{-1} (Theta_k - Theta_{k-1}): each iteration adds a correction
that shrinks, and rounding does not build up with k.
Always started cold: one warm step per measurement drifts on singular data.

With forgetting < 1 use refinements = 1 (`EstimatorSettings.solve_iterations`): the refill already
centres the prior on the last estimate, which is the proximal step; a second would double-count it.
"""

import numpy as np

from .compiled import Array, compiled
from .triangular import back_substitute, forward_substitute


def solve(R: Array, D: Array, rho: float, refinements: int, centre: Array | None = None) -> Array:
    """Theta (n, d) after `refinements` iterations of eq. 7.

    R (d, d) upper triangular, D (d, n), rho the prior's weight in R^T R, centre (d, n) the prior's
    mean Theta_0^T (None: 0).
    Raises ValueError for shapes that do not fit or a count below 1.
    """
    d = R.shape[0]
    if R.shape != (d, d) or D.ndim != 2 or D.shape[0] != d:
        raise ValueError(f"R is {R.shape} and D is {D.shape}; expected (d, d) and (d, n)")
    if refinements < 1:
        raise ValueError(f"refinements is {refinements}; expected 1 or more")
    Theta_T = np.array(D, dtype=np.float64, order="C")
    mean = np.zeros_like(Theta_T) if centre is None else np.ascontiguousarray(centre)
    _iterate(np.ascontiguousarray(R, dtype=np.float64), Theta_T, rho, refinements, mean)
    return np.ascontiguousarray(Theta_T.T)


@compiled
def _iterate(R: Array, Theta_T: Array, rho: float, refinements: int, centre: Array) -> None:
    """Theta_T (d, n): D on entry, Theta_k^T on return."""
    back_substitute(R, Theta_T)
    correction = Theta_T - centre
    for _ in range(refinements - 1):
        forward_substitute(R, correction)
        back_substitute(R, correction)
        for i in range(Theta_T.shape[0]):
            for j in range(Theta_T.shape[1]):
                correction[i, j] *= rho
                Theta_T[i, j] += correction[i, j]
