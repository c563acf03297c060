"""The square-root information factor of one stream, updated by Givens rotations (QR-RLS).

Convention: R is upper triangular with a positive diagonal, and

    R^T R = W W^T + rho I,      R^T D = W Y^T  (+ rho centre^T once the prior was refilled),

so eq. 5 is one triangular solve and W W^T, whose condition number is W's squared, is never formed.
A measurement is one orthogonal transformation of the stacked rows:

    orthogonal * [ sqrt(lambda) R   sqrt(lambda) D ]  =  [ R'  D'  ]
                 [      w^T              y^T       ]     [ 0   e^T ]

e is the innovation divided by sqrt(1 + w^T (R^T R)^{-1} w): its covariance is the residual's.

Forgetting (lambda < 1) would let the prior decay, and at rest the factor would collapse. So in turn
each row i of the prior gets back what it lost, as a measurement sqrt(rho - rho_i) [e_i | a_i],
where a_i is row i of the estimate last solved, once a cycle. Centred there it is the proximal step
of eq. 7 and it does not pull the estimate toward zero. When lambda = 1 nothing is refilled.
"""

from dataclasses import dataclass

import numpy as np

from .compiled import Array, compiled
from .settings import EstimatorSettings
from .triangular import back_substitute
from .window import slide

#: Largest magnitude accepted in a measurement; beyond it squares could overflow.
LARGEST = 1e100


@dataclass(slots=True, eq=False)
class Factor:
    """The state of one stream; `update` changes it in place.

    rows: (d + 2, d + n); [R D] above two scratch rows, the first of which ends in the innovation.
    innovation: (n,) view of that end, overwritten by the next update.
    anchor: (d, n) Theta^T last solved, toward which the prior is refilled (lambda < 1).
    centre: (d, n) what the whole prior is centred on (only with a window, which needs it to rebuild).
    ring: (N, d + n) the last N measurements [w^T y^T] (only with a window; else N = 0).
    steps: measurements folded.
    """

    rows: Array
    innovation: Array
    anchor: Array
    centre: Array
    ring: Array
    steps: int = 0

    @property
    def R(self) -> Array:
        """(d, d) upper triangular."""
        d = len(self.rows) - 2
        return self.rows[:d, :d]

    @property
    def D(self) -> Array:
        """(d, n)."""
        d = len(self.rows) - 2
        return self.rows[:d, d:]


def init(settings: EstimatorSettings) -> Factor:
    """The prior alone: R = sqrt(rho) I, D = 0."""
    d, n = settings.regressor_size, settings.code_size
    rows = np.zeros((d + 2, d + n))
    np.fill_diagonal(rows[:d, :d], np.sqrt(settings.rho))
    window = settings.window or 0
    return Factor(
        rows=rows,
        innovation=rows[d, d:],
        anchor=np.zeros((d, n)),
        centre=np.zeros((d if window else 0, n)),
        ring=np.zeros((window, d + n)),
    )


def update(factor: Factor, settings: EstimatorSettings, w: Array, y: Array) -> Array:
    """Fold one measurement, w (d,) and y (n,) float64, into the factor, in place.

    Returns the normalised innovation e (n,): a view, overwritten by the next update.
    Raises ValueError (and changes nothing) for wrong shapes or numbers that are not finite.
    """
    steps = factor.steps + 1
    if settings.keeps_everything:
        accepted = fold(factor.rows, w, y)
    else:
        accepted = fold_and_forget(
            factor.rows,
            factor.anchor,
            factor.centre,
            factor.ring,
            w,
            y,
            steps,
            settings.rho,
            settings.forgetting,
            settings.refill_stride,
            settings.refill_weights,
        )
    if not accepted:
        raise ValueError(_complaint(settings, w, y))
    factor.steps = steps
    return factor.innovation


def _complaint(settings: EstimatorSettings, w: Array, y: Array) -> str:
    d, n = settings.regressor_size, settings.code_size
    if w.shape != (d,) or y.shape != (n,):
        return f"w has shape {w.shape} and y {y.shape}; expected ({d},) and ({n},)"
    return f"w or y holds a number that is not finite; expected magnitudes up to {LARGEST:g}"


@compiled
def fold(rows: Array, w: Array, y: Array) -> bool:
    """Fold (w, y) without forgetting; False, and nothing changed, for an unfit measurement."""
    if not place(rows, w, y):
        return False
    rotate(rows, rows[w.shape[0]], 0, 1.0)
    return True


@compiled
def fold_and_forget(
    rows: Array,
    anchor: Array,
    centre: Array,
    ring: Array,
    w: Array,
    y: Array,
    steps: int,
    rho: float,
    forgetting: float,
    stride: int,
    weights: Array,
) -> bool:
    """Fold (w, y) as measurement number `steps` (from 1), with forgetting, refill and window."""
    if not place(rows, w, y):
        return False
    d = w.shape[0]
    rotate(rows, rows[d], 0, np.sqrt(forgetting))
    if ring.shape[0] > 0:
        x = rows[d + 1]
        x[:d] = w
        x[d:] = y
        slide(rows, centre, ring, steps, rho, forgetting, stride)
    if stride > 0 and steps % stride == 0:
        refill(rows, anchor, centre, steps, stride, weights)
    return True


@compiled
def place(rows: Array, w: Array, y: Array) -> bool:
    """Copy the measurement into the first scratch row, if its shape and its numbers are fit."""
    d, n = w.shape[0], y.shape[0]
    if rows.shape[0] != d + 2 or rows.shape[1] != d + n:
        return False
    unfit = 0
    for j in range(d):
        unfit += not abs(w[j]) <= LARGEST
    for j in range(n):
        unfit += not abs(y[j]) <= LARGEST
    if unfit:
        return False
    x = rows[d]
    for j in range(d):
        x[j] = w[j]
    tail = x[d:]
    for j in range(n):
        tail[j] = y[j]
    return True


@compiled
def rotate(rows: Array, x: Array, first: int, decay: float) -> None:
    """Rotate row x (d + n,) into [R D], both scaled by `decay` first; x ends as [.. e^T].

    x must be zero before column `first`. The next pivot is formed ahead of the row's loop: the
    square root and the divisions are the critical path. Adding 0.0 turns -0.0 into 0.0, so that
    rotating a row of zeros leaves every bit as it is, which the batched kernel relies on.
    """
    b = x[first]
    for i in range(first, rows.shape[0] - 2):
        a = decay * rows[i, i]
        r = np.sqrt(a * a + b * b)
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
def refill(
    rows: Array, anchor: Array, centre: Array, steps: int, stride: int, weights: Array
) -> None:
    """Give row i of the prior back what it lost since its last turn (see above)."""
    d = anchor.shape[0]
    turn = steps // stride - 1
    i = turn % d
    if i == 0:
        anchor[:] = rows[:d, d:]
        back_substitute(rows, anchor)
    weight = weights[min(turn, d - 1)]
    if centre.shape[0] > 0:
        centre[i] += (weight * weight) / (rows.shape[0]) * 0.0
    x = rows[d + 1]
    x[:] = 0.0
    x[i] = weight
    x[d:] = weight * anchor[i]
    rotate(rows, x, i, 1.0)
