"""Solving the condensed QP, and judging the answer by its own optimality conditions.

ProxQP's word is not taken for the status (see `proxqp.py`): the KKT residual is computed here.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .problem import CondensedQP
from .proxqp import solve_box

Array = NDArray[np.float64]

Status = Literal["solved", "inaccurate", "infeasible", "failed"]

#: Largest relative KKT residual that still counts as solved.
SOLVED_RESIDUAL = 1e-6
_ACCURACY = 1e-10
_ITERATIONS = 200


@dataclass(frozen=True, eq=False)
class QPSolution:
    """The controls and how far to trust them.

    u: (N, p), in the controls' unit, always finite and inside the bounds.
    cost: eq. 13's value at u; infinite when the problem itself is not finite.
    status: "solved": KKT residual at most 1e-6. "inaccurate": best found, not optimal; shorten the
        horizon or raise R. "infeasible": the solver found the bounds contradictory. "failed": the
        problem is not finite (an unstable model over a long horizon); u is then the admissible
        control nearest to zero.
    kkt_residual: see `kkt_residual`; infinite when failed.
    """

    u: Array
    cost: float
    status: Status
    kkt_residual: float


def solve_qp(qp: CondensedQP) -> QPSolution:
    """Minimise the QP inside its bounds; a numerical outcome is a status, never an exception."""
    # Values near the largest float overflow on the way; the residual then says so.
    with np.errstate(over="ignore", invalid="ignore"):
        if not _is_finite(qp):
            return _failure(qp)
        u, empty = _proximal_solution(qp)
        u, residual = _polish(qp, u)
        cost = qp.cost(u)
    if not (np.isfinite(residual) and np.isfinite(cost)):
        return _failure(qp)
    status = _judge(residual, empty)
    return QPSolution(u.reshape(-1, qp.control_size), cost, status, residual)


def kkt_residual(qp: CondensedQP, u: Array) -> float:
    """How far the flat u (N*p,) is from optimal, relative to the largest control; 0 if it is.

    The KKT conditions hold exactly where the step -gradient / diag(H), cut off at the bounds, leads
    nowhere; the residual is the largest such step over the largest control in play. It needs no
    multipliers, so there is nothing to believe the solver about.
    """
    return _residual(qp, u, qp.gradient(u))


def _residual(qp: CondensedQP, u: Array, gradient: Array) -> float:
    scale = 1.0 / np.diagonal(qp.H)
    step = u - _inside(qp, u - gradient * scale)
    reach = max(float(np.abs(qp.g * scale).max()), float(np.abs(u).max()))
    return float(np.abs(step).max()) / reach if reach > 0.0 else 0.0


def _inside(qp: CondensedQP, u: Array) -> Array:
    """u cut off at the bounds."""
    return np.minimum(np.maximum(u, qp.lower), qp.upper)


def _is_finite(qp: CondensedQP) -> bool:
    finite = np.isfinite(qp.H).all() and np.isfinite(qp.g).all() and np.isfinite(qp.constant)
    return bool(finite)


def _judge(residual: float, empty: bool) -> Status:
    if residual <= SOLVED_RESIDUAL:
        return "solved"
    return "infeasible" if empty else "inaccurate"


def _failure(qp: CondensedQP) -> QPSolution:
    nearest = _inside(qp, np.zeros_like(qp.g))
    return QPSolution(nearest.reshape(-1, qp.control_size), np.inf, "failed", np.inf)


def _proximal_solution(qp: CondensedQP) -> tuple[Array, bool]:
    """ProxQP on the problem in units where H and g have entries near 1, cut to the bounds."""
    h, g = float(np.diagonal(qp.H).max()), float(np.abs(qp.g).max())
    unit = g / h if g > 0.0 else 1.0
    v, empty = solve_box(
        qp.H / h,
        qp.g / (h * unit),
        qp.lower / unit,
        qp.upper / unit,
        accuracy=_ACCURACY,
        iterations=_ITERATIONS,
    )
    u = np.where(np.isfinite(v), v * unit, 0.0)
    return _inside(qp, u), empty


def _polish(qp: CondensedQP, u: Array) -> tuple[Array, float]:
    """One exact step: guess which controls sit on bounds, solve for the rest, keep what is better.

    ProxQP stops a little off the bounds; those that a gradient step pushes onto one belong there.
    """
    gradient = qp.gradient(u)
    residual = _residual(qp, u, gradient)
    snapped = _inside(qp, u - gradient / np.diagonal(qp.H))
    free = np.flatnonzero((snapped > qp.lower) & (snapped < qp.upper))
    snapped[free] = u[free]
    try:
        step = np.linalg.solve(qp.H[np.ix_(free, free)], qp.gradient(snapped)[free])
    except np.linalg.LinAlgError:
        return u, residual
    snapped[free] -= step
    polished = _inside(qp, snapped)
    polished_residual = kkt_residual(qp, polished)
    return (polished, polished_residual) if polished_residual < residual else (u, residual)
