"""Random systems and a brute-force oracle, for the tests of this folder."""

import itertools

import numpy as np

from koop_service.prediction.model import LinearModel


def random_model(rng, n=8, h=2, p=1, radius=1.0, affine=True):
    """A model with the given spectral radius."""
    A = rng.normal(size=(n, n * h))
    model = LinearModel(A, rng.normal(size=(n, p)), rng.normal(size=n) * 0.1 * affine)
    # Scaling the block of lag i by s^i scales every pole by s.
    s = radius / model.spectral_radius()
    return LinearModel(A * np.repeat(s ** np.arange(h, 0, -1.0), n), model.B, model.c)


def random_weight(rng, size, floor=0.1):
    """A full symmetric positive definite matrix."""
    root = rng.normal(size=(size, size))
    return root @ root.T / size + floor * np.eye(size)


def simulated_cost(model, history, target, controls, Q, R):
    """Eq. 13, step by step: nothing is condensed."""
    codes, cost = list(history), 0.0
    for u in controls:
        x = np.concatenate(codes[-model.history :])
        codes.append(model.A @ x + model.B @ u + model.c)
        error = codes[-1] - target
        cost += error @ Q @ error + u @ R @ u
    return cost


def best_by_enumeration(qp):
    """The minimiser of a small box QP: every choice of who sits on which bound."""
    size = len(qp.g)
    best, best_cost = None, np.inf
    for sides in itertools.product((-1, 0, 1), repeat=size):
        side = np.array(sides)
        u = np.where(side < 0, qp.lower, np.where(side > 0, qp.upper, 0.0))
        free = side == 0
        if free.any():
            held = qp.g[free] + qp.H[np.ix_(free, ~free)] @ u[~free]
            u[free] = np.linalg.solve(qp.H[np.ix_(free, free)], -held)
        if (
            (u >= qp.lower - 1e-12).all()
            and (u <= qp.upper + 1e-12).all()
            and qp.cost(u) < best_cost
        ):
            best, best_cost = u, qp.cost(u)
    return best
