"""What the factor says about certainty: Theta is matrix-normal given the measurements.

With residual covariance S (n, n), rows of Theta have covariance S and columns (R^T R)^{-1}, so a
prediction Theta w of the next code has covariance S (1 + w^T (R^T R)^{-1} w).
"""

import numpy as np

from .compiled import Array
from .triangular import forward_substitute


def regressor_leverage(R: Array, w: Array) -> Array:
    """w^T (R^T R)^{-1} w: of w (d,) a scalar array (), of w (K, d) the K values (K,).

    Near 0 for a regressor well inside what was measured; above 1 the prediction is a guess.
    """
    d = R.shape[0]
    if R.shape != (d, d) or w.shape[-1] != d:
        raise ValueError(f"R is {R.shape} and w {w.shape}; expected (d, d) and (.., d)")
    columns = np.array(np.atleast_2d(w).T, dtype=np.float64, order="C")
    forward_substitute(np.ascontiguousarray(R), columns)
    return np.einsum("ik,ik->k", columns, columns).reshape(w.shape[:-1])


def predictive_covariance(S: Array, R: Array, w: Array) -> Array:
    """Covariance (n, n) of the next code, predicted from regressor w (d,): noise and doubt."""
    return S * (1.0 + regressor_leverage(R, w))


def excitation(R: Array, rho: float) -> float:
    """Smallest singular value of R over sqrt(rho): how far the weakest direction rises above the
    prior.

    1 (or a little less under forgetting) means that some direction of the regressor was never
    excited and its coefficients are the prior's; 10 that the data there outweigh the prior 100:1.
    """
    smallest = np.linalg.svd(R, compute_uv=False)[-1]
    return float(smallest / np.sqrt(rho))
