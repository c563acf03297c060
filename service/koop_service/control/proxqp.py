"""The one place that touches ProxSuite, which has no types: a box QP in, arrays and a word out.

Always a new solver: in ProxSuite 0.8 an updated, warm-started one can report "solved" with wrong
controls (measured), and a cold start costs well under 0.1 ms here.
"""

from typing import Any, cast

import numpy as np
import proxsuite  # pyright: ignore[reportMissingImports]  (a path file hides it)
from numpy.typing import NDArray

Array = NDArray[np.float64]

_proxqp = cast(Any, proxsuite).proxqp


def solve_box(
    H: Array, g: Array, lower: Array, upper: Array, *, accuracy: float, iterations: int
) -> tuple[Array, bool]:
    """Minimise 1/2 x^T H x + g^T x in the box: x, and whether ProxQP called the box empty.

    `accuracy` is absolute, on gradient and constraints: scale the problem to entries near 1.
    x is what the last iteration left, good or not; the caller must check it.
    """
    solver = _proxqp.dense.QP(len(g), 0, 0, True)
    solver.settings.eps_abs = accuracy
    solver.settings.eps_rel = 0.0
    solver.settings.max_iter = iterations
    solver.init(H, g, l_box=lower, u_box=upper)
    solver.solve()
    empty = solver.results.info.status == _proxqp.QPSolverOutput.PROXQP_PRIMAL_INFEASIBLE
    return np.array(solver.results.x, dtype=np.float64), bool(empty)
