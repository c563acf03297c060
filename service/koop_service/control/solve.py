"""Solving the condensed QP, and judging the answer by its own optimality conditions.

ProxQP's word is not taken for the status (see `proxqp.py`): the KKT residual is computed here. The
last plan is a first guess and nothing more: it is polished, and kept only if that is optimal.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .active_set import Guess, guess_at, refine
from .condense import CondensedQP
from .optimality import Candidate, admissible
from .plan import rest_of_plan
from .proxqp import Rows, solve_box

Array = NDArray[np.float64]

Status = Literal["solved", "inaccurate", "infeasible", "failed"]

#: Largest relative KKT residual that still counts as solved.
SOLVED_RESIDUAL = 1e-6
_WARM_RESIDUAL = 1e-9
_WARM_ROUNDS = 4
_POLISHED = 1e-12
_ACCURACY, _FINER = 1e-10, 1e-13
"""Of ProxQP, absolute. The finer one is for a long horizon of an unstable model, where H's
eigenvalues lie nine decades apart."""
_ITERATIONS = 200


@dataclass(frozen=True, eq=False)
class QPSolution:
    """The controls and how far to trust them.

    u: (N, p), in the controls' unit, always finite and inside the bounds and rates.
    cost: the problem's value at u; infinite when the problem itself is not finite.
    status: "solved": KKT residual at most 1e-6. "inaccurate": best found, not optimal; shorten the
        horizon or raise R. "infeasible": the solver found the bounds contradictory. "failed": the
        problem is not finite (an unstable model over a long horizon); u is then the admissible
        control nearest to zero.
    kkt_residual: see `kkt_residual`; infinite when failed.
    rates: ((N-1)*p,) multipliers of the rate bounds, the residual's witnesses; or empty.
    bounds: (N*p,) multipliers of the bounds on u, which the next solution starts from.
    warm: whether it came out of the last solution, without ProxQP.
    """

    u: Array
    cost: float
    status: Status
    kkt_residual: float
    rates: Array = field(default_factory=lambda: np.zeros(0))
    bounds: Array = field(default_factory=lambda: np.zeros(0))
    warm: bool = False


def solve_qp(qp: CondensedQP, last: QPSolution | None = None, elapsed: int = 1) -> QPSolution:
    """Minimise the QP inside its bounds; a numerical outcome is a status, never an exception.

    last: the solution of the same task `elapsed` steps ago, to start from: faster where hardly
    anything changed, else of no effect.
    """
    # Values near the largest float overflow on the way; the residual then says so.
    with np.errstate(over="ignore", invalid="ignore"):
        if not _is_finite(qp):
            return _failure(qp)
        if last is not None and (found := _from_last(qp, last, elapsed)) is not None:
            return _solution(qp, found, empty=False, warm=True)
        return _solution(qp, *_from_scratch(qp), warm=False)


def _from_last(qp: CondensedQP, last: QPSolution, elapsed: int) -> Candidate | None:
    """The last solution, shifted and polished; None unless that is optimal here."""
    if len(last.bounds) != len(qp.g) or len(last.rates) != len(qp.rate_lower):
        return None
    p = qp.control_size
    u, bounds, rates = (
        rest_of_plan(part.reshape(-1, p), elapsed).reshape(-1) if part.size else part
        for part in (last.u, last.bounds, last.rates)
    )
    found = refine(qp, Guess(u, bounds, rates), _WARM_ROUNDS, _WARM_RESIDUAL)
    return found if found.residual <= _WARM_RESIDUAL else None


def _from_scratch(qp: CondensedQP) -> tuple[Candidate, bool]:
    """ProxQP's answer, polished; where that is not optimal, what a finer accuracy makes of it."""
    found, empty = _polished(qp, _ACCURACY)
    if found.residual <= SOLVED_RESIDUAL:
        return found, empty
    finer, empty = _polished(qp, _FINER)
    return (finer if finer.residual < found.residual else found), empty


def _polished(qp: CondensedQP, accuracy: float) -> tuple[Candidate, bool]:
    """ProxQP stops a little off the bounds."""
    u, rates, empty = _proximal_solution(qp, accuracy)
    return refine(qp, guess_at(qp, u, rates), rounds=1, enough=_POLISHED), empty


def _proximal_solution(qp: CondensedQP, accuracy: float) -> tuple[Array, Array, bool]:
    """ProxQP on the problem in units where H and g have entries near 1."""
    h, g = float(np.diagonal(qp.H).max()), float(np.abs(qp.g).max())
    unit = g / h if g > 0.0 else 1.0
    answer = solve_box(
        qp.H / h,
        qp.g / (h * unit),
        qp.lower / unit,
        qp.upper / unit,
        Rows(qp.rate_rows(), qp.rate_lower / unit, qp.rate_upper / unit),
        accuracy=accuracy,
        iterations=_ITERATIONS,
    )
    u = np.where(np.isfinite(answer.x), answer.x * unit, 0.0)
    rates = np.where(np.isfinite(answer.rows), answer.rows * (h * unit), 0.0)
    return u, rates, answer.empty


def _solution(qp: CondensedQP, found: Candidate, empty: bool, warm: bool) -> QPSolution:
    cost = qp.cost(found.u)
    if not (np.isfinite(found.residual) and np.isfinite(cost)):
        return _failure(qp)
    return QPSolution(
        found.u.reshape(-1, qp.control_size),
        cost,
        _judge(found.residual, empty),
        found.residual,
        found.rates,
        -found.slope,
        warm,
    )


def _judge(residual: float, empty: bool) -> Status:
    if residual <= SOLVED_RESIDUAL:
        return "solved"
    return "infeasible" if empty else "inaccurate"


def _is_finite(qp: CondensedQP) -> bool:
    finite = np.isfinite(qp.H).all() and np.isfinite(qp.g).all() and np.isfinite(qp.constant)
    return bool(finite)


def _failure(qp: CondensedQP) -> QPSolution:
    nearest = admissible(qp, np.zeros_like(qp.g))
    return QPSolution(nearest.reshape(-1, qp.control_size), np.inf, "failed", np.inf)
