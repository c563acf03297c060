"""The one place that touches ProxSuite, which has no types: a QP in, arrays and a word out.

Always a new solver: in ProxSuite 0.8 an updated, warm-started one can report "solved" with wrong
controls (measured), and a cold start costs well under 0.5 ms here.
"""

from typing import Any, NamedTuple, cast

import numpy as np
import proxsuite  # pyright: ignore[reportMissingImports]  (a path file hides it)
from numpy.typing import NDArray

Array = NDArray[np.float64]

_proxqp = cast(Any, proxsuite).proxqp

# At its default, 1e-4, ProxSuite 0.8 called one of a hundred rate-bounded problems infeasible that
# were not, well-conditioned ones among them.
_EMPTY = 1e-12


class Rows(NamedTuple):
    """lower <= C x <= upper, C (m, size of x)."""

    C: Array
    lower: Array
    upper: Array


class Answer(NamedTuple):
    """What the last iteration left, good or not; the caller must check it.

    rows: multipliers of the rows, positive on an upper bound. empty: whether ProxQP found that
    nothing satisfies the bounds.
    """

    x: Array
    rows: Array
    empty: bool


def solve_box(
    H: Array, g: Array, lower: Array, upper: Array, rows: Rows, *, accuracy: float, iterations: int
) -> Answer:
    """Minimise 1/2 x^T H x + g^T x with lower <= x <= upper and the rows.

    `accuracy` is absolute, on gradient and constraints: scale the problem to entries near 1.
    """
    m = len(rows.C)
    solver = _proxqp.dense.QP(len(g), 0, m, True)
    solver.settings.eps_abs = accuracy
    solver.settings.eps_rel = 0.0
    solver.settings.max_iter = iterations
    solver.settings.eps_primal_inf = _EMPTY
    inside = {"C": rows.C, "l": rows.lower, "u": rows.upper} if m else {}
    solver.init(H, g, **inside, l_box=lower, u_box=upper)
    solver.solve()
    empty = solver.results.info.status == _proxqp.QPSolverOutput.PROXQP_PRIMAL_INFEASIBLE
    multipliers = np.array(solver.results.z, dtype=np.float64)[:m]  # those of the box follow
    return Answer(np.array(solver.results.x, dtype=np.float64), multipliers, bool(empty))
