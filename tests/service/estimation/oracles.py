"""Naive dense formulas in 50-digit arithmetic, to compare the streaming factor with.

Matrices are NumPy object arrays of mpmath numbers. Nothing here is fast or clever: the paper's
KKT system as it stands, its primal form as a dense solve, and the exponentially weighted
information matrices with the refilled prior accounted for row by row.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np

DIGITS = 50


def exact(values: Any) -> np.ndarray:
    """Array of 50-digit numbers equal to float64 `values`."""
    mpmath.mp.dps = DIGITS
    return np.vectorize(mpmath.mpf, otypes=[object])(np.asarray(values, dtype=np.float64))


def rounded(values: np.ndarray) -> np.ndarray:
    """The nearest float64 array."""
    return values.astype(np.float64)


def factorise(M: np.ndarray) -> np.ndarray:
    """L (unit lower) and the pivots on its diagonal: M = L diag L^T, M symmetric, no pivoting."""
    L = M.copy()
    for i in range(len(L)):
        L[i + 1 :, i] /= L[i, i]
        for j in range(i + 1, len(L)):
            L[j:, j] -= L[j:, i] * (L[j, i] * L[i, i])
    return L


def solve_factorised(L: np.ndarray, B: np.ndarray) -> np.ndarray:
    """M^{-1} B from `factorise(M)`."""
    X = B.copy()
    for i in range(len(L)):
        X[i + 1 :] -= np.outer(L[i + 1 :, i], X[i])
    X /= np.diag(L)[:, None]
    for i in range(len(L) - 1, -1, -1):
        X[i] -= L[i + 1 :, i] @ X[i + 1 :]
    return X


def theta_kkt(W: np.ndarray, Y: np.ndarray, rho: float, k: int) -> np.ndarray:
    """Theta_k (n, d) by k iterations of the paper's eq. 7, from Lambda_0 = 0.

    W (K, d) and Y (K, n) hold a measurement a row. The system is quasi-definite (rho > 0), so
    L D L^T without pivoting exists.
    """
    W, Y, rho = exact(W), exact(Y), mpmath.mpf(rho)
    K, d = W.shape
    system = np.block([[exact(np.eye(d)), W.T], [W, -rho * exact(np.eye(K))]])
    L = factorise(system)
    Lambda = exact(np.zeros(Y.shape))
    solution = np.vstack([exact(np.zeros((d, Y.shape[1]))), Lambda])
    for _ in range(k):
        right = np.vstack([exact(np.zeros((d, Y.shape[1]))), Y - rho * solution[d:]])
        solution = solve_factorised(L, right)
    return solution[:d].T


def theta_dense(W: np.ndarray, Y: np.ndarray, rho: float, k: int) -> np.ndarray:
    """Theta_k (n, d) by eq. 7's primal form, (rho Theta_{k-1} + Y W^T) (W W^T + rho I)^{-1}."""
    W, Y, rho = exact(W), exact(Y), mpmath.mpf(rho)
    L = factorise(W.T @ W + rho * exact(np.eye(W.shape[1])))
    Theta_T = exact(np.zeros((W.shape[1], Y.shape[1])))
    for _ in range(k):
        Theta_T = solve_factorised(L, W.T @ Y + rho * Theta_T)
    return Theta_T.T


@dataclass
class DenseStream:
    """R^T R (d, d) and R^T D (d, n) of a forgetting stream by their definition, 50 digits.

    M <- lambda M + w w^T, C <- lambda C + w y^T; every `stride` steps the next row i of the prior,
    which then weighs rho_i, gets rho - rho_i back, centred on the estimate solved at i = 0.
    """

    M: np.ndarray
    C: np.ndarray
    rho: float
    forgetting: float
    stride: int

    def __post_init__(self) -> None:
        self.prior = np.diag(self.M).copy()
        self.anchor = self.C * 0
        self.steps = 0

    def fold(self, w: np.ndarray, y: np.ndarray) -> None:
        w, y, forgetting = exact(w), exact(y), mpmath.mpf(self.forgetting)
        self.M = forgetting * self.M + np.outer(w, w)
        self.C = forgetting * self.C + np.outer(w, y)
        self.prior = forgetting * self.prior
        self.steps += 1
        if self.stride and self.steps % self.stride == 0:
            self._refill((self.steps // self.stride - 1) % len(w))

    def _refill(self, i: int) -> None:
        if i == 0:
            self.anchor = self.theta().T
        lost = mpmath.mpf(self.rho) - self.prior[i]
        self.M[i, i] += lost
        self.C[i] = self.C[i] + lost * self.anchor[i]
        self.prior[i] += lost

    def theta(self) -> np.ndarray:
        return solve_factorised(factorise(self.M), self.C).T


def dense_stream(d: int, n: int, rho: float, forgetting: float, stride: int) -> DenseStream:
    M, C = exact(rho * np.eye(d)), exact(np.zeros((d, n)))
    return DenseStream(M, C, rho, forgetting, stride)


#: Ways to make K regressors (K, d), by what is known of their condition number.
Regressors = Callable[[np.random.Generator, int, int], np.ndarray]


def conditioned(condition: float) -> Regressors:
    """Regressors whose singular values fall geometrically from sqrt(K) by `condition`."""

    def draw(rng: np.random.Generator, K: int, d: int) -> np.ndarray:
        left = np.linalg.qr(rng.standard_normal((K, d)))[0]
        right = np.linalg.qr(rng.standard_normal((d, d)))[0]
        return np.sqrt(K) * left * np.geomspace(1.0, 1.0 / condition, d) @ right.T

    return draw


def singular(rng: np.random.Generator, K: int, d: int) -> np.ndarray:
    """Exactly singular: small integers, the last third of the columns sums of the others."""
    free = d - d // 3
    W = rng.integers(-8, 9, size=(K, d)) / 8.0
    for j in range(free, d):
        W[:, j] = W[:, j - free] + W[:, j - free + 1]
    return W


def lifted_pendulum(rng: np.random.Generator, K: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """W (K, 2 n) and Y (K, n) of a swinging pendulum's codes: smooth, so strongly correlated.

    The codes are random features of (angle, speed) with an encoder's noise of 1e-3.
    """
    lift = rng.standard_normal((n, 4))
    angle, speed, dt = rng.uniform(1.8, 2.5), 0.0, 0.05
    codes = []
    for _ in range(K + 2):
        state = [np.sin(angle), np.cos(angle), 0.2 * speed, 0.3]
        codes.append(np.tanh(lift @ state) + 1e-3 * rng.standard_normal(n))
        for _ in range(10):
            speed += dt / 10 * 9.81 / 0.5 * np.sin(angle)
            angle += dt / 10 * speed
    Z = np.array(codes)
    return np.hstack([Z[:-2], Z[1:-1]]), Z[2:]
