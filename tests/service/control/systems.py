"""Random systems and a brute-force oracle, for the tests of this folder."""

import itertools

import numpy as np

from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import rollout


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


def pendulum(p=1, h=1, gravity=20.0, dt=0.05):
    """An inverted pendulum at its top, of codes (angle, rate); more controls, less of each.

    z = (angle, rate), explicit in dt; unstable, and every angle needs a torque to be held at.
    """
    F = np.array([[1.0, dt], [gravity * dt, 1.0]])
    B = np.array([[0.0], [dt]]) / np.arange(1, p + 1)
    return LinearModel(np.concatenate([np.zeros((2, 2 * (h - 1))), F], axis=1), B, np.zeros(2))


def closed_loop(model, history, controller, steps):
    """Codes (steps, n) and controls (steps, p) under u_t = controller(history, u_{t-1}, t)."""
    codes, controls = list(history), [np.zeros(model.control_size)]
    for t in range(steps):
        seen = np.stack(codes[-model.history :])
        controls.append(np.asarray(controller(seen, controls[-1], t)))
        codes.append(rollout(model, seen, controls[-1][None])[0])
    return np.stack(codes[model.history :]), np.stack(controls[1:])


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
    """The minimiser of a small QP: every choice of which rows sit on which of their bounds."""
    rows = np.concatenate([np.eye(len(qp.g)), qp.rate_rows()])
    lower = np.concatenate([qp.lower, qp.rate_lower])
    upper = np.concatenate([qp.upper, qp.rate_upper])
    best, best_cost = None, np.inf
    for sides in itertools.product((-1, 0, 1), repeat=len(rows)):
        side = np.array(sides)
        held = side != 0
        goal = np.where(side < 0, lower, upper)[held]
        if held.sum() > len(qp.g) or not np.isfinite(goal).all():
            continue
        u = _best_with_held(qp, rows[held], goal)
        values = rows @ u
        if (
            (values >= lower - 1e-12).all()
            and (values <= upper + 1e-12).all()
            and qp.cost(u) < best_cost
        ):
            best, best_cost = u, qp.cost(u)
    return best


def _best_with_held(qp, rows, goal):
    """The minimiser with rows u = goal: a point there, and the best step that keeps it."""
    start = np.linalg.lstsq(rows, goal, rcond=None)[0] if len(rows) else np.zeros(len(qp.g))
    still = np.linalg.svd(rows)[2][len(rows) :].T if len(rows) else np.eye(len(qp.g))
    if not still.size:
        return start
    return start + still @ np.linalg.solve(still.T @ qp.H @ still, -still.T @ qp.gradient(start))
