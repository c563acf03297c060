"""The square-root information factor of one stream, updated by Givens rotations (QR-RLS).

Convention: R is upper triangular with a positive diagonal, and

    R^T R = W W^T + rho I,      R^T D = W Y^T + rho centre,

so eq. 5 is one triangular solve and W W^T, whose condition number is W's squared, is never formed.
centre (d, n) is the Theta^T that the prior is centred on: the settings' `prior_mean`, until refills
(below) move it.
A measurement is one orthogonal transformation of the stacked rows:

    orthogonal * [ sqrt(lambda) R   sqrt(lambda) D ]  =  [ R'  D'  ]
                 [      w^T              y^T       ]     [ 0   e^T ]

e is the innovation divided by sqrt(1 + w^T (R^T R)^{-1} w): its covariance is the residual's.

Forgetting (lambda < 1) would let the prior decay, and at rest the factor would collapse. So in turn
each row i of the prior gets back what it lost, as a measurement sqrt(rho - rho_i) [e_i | a_i],
where a_i is row i of the estimate last solved, once a cycle. Centred there it is the proximal step
of eq. 7 and it does not pull the estimate toward zero. When lambda = 1 nothing is refilled.
"""

import math
from dataclasses import dataclass

import numpy as np

from .compiled import Array, compiled
from .rotations import rotate
from .settings import EstimatorSettings
from .triangular import back_substitute
from .window import slide

#: Largest magnitude accepted in a measurement; beyond it squares could overflow.
LARGEST = 1e100
_LARGEST_ENTRY = 1e120  # of a factor: more than any number of measurements adds up to


@dataclass(slots=True, eq=False)
class Factor:
    """The state of one stream; `update` changes it in place.

    rows: (d + 2, d + n); [R D] above two scratch rows, the first of which ends in the innovation.
    innovation: (n,) view of that end, overwritten by the next update.
    anchor: (d, n) Theta^T last solved, the target of refills (lambda < 1; else (0, n)).
    centre: (d, n) what the prior as a whole is centred on (for a window's rebuilds; else (0, n)).
    ring: (N, d + n) the last N measurements [w^T y^T] (without a window N = 0).
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
    """The prior alone: R = sqrt(rho) I, D = sqrt(rho) centre."""
    d, n = settings.regressor_size, settings.code_size
    rows = np.zeros((d + 2, d + n))
    np.fill_diagonal(rows[:d, :d], np.sqrt(settings.rho))
    rows[:d, d:] = np.sqrt(settings.rho) * settings.centre
    window = settings.window or 0
    return Factor(
        rows=rows,
        innovation=rows[d, d:],
        anchor=settings.centre[: d if settings.refill_stride else 0].copy(),
        centre=settings.centre[: d if window else 0].copy(),
        ring=np.zeros((window, d + n)),
    )


def check(settings: EstimatorSettings, factor: Factor) -> None:
    """Raises ValueError where a factor, say from a snapshot, does not fit the settings."""
    expected = init(settings)
    for name in ("rows", "anchor", "centre", "ring"):
        found, wanted = getattr(factor, name).shape, getattr(expected, name).shape
        if found != wanted:
            raise ValueError(f"the factor's {name} has shape {found}; expected {wanted}")
    arrays = (factor.R, factor.D, factor.anchor, factor.centre, factor.ring)
    if not all(np.all(np.abs(array) <= _LARGEST_ENTRY) for array in arrays):
        raise ValueError(
            "the factor holds a number that is not finite, or so large that its square is not;"
            f" expected magnitudes up to {_LARGEST_ENTRY:g}"
        )
    if not np.all(np.diag(factor.R) > 0.0) or factor.steps < 0:
        raise ValueError("the factor's R or steps is impossible; expected R's diagonal positive")


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
            settings.refill_losses,
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
    d = w.shape[0]
    rotate(rows, rows[d], 0, d, 1.0)
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
    losses: Array,
) -> bool:
    """Fold (w, y) as measurement number `steps` (from 1), with forgetting, refill and window."""
    if not place(rows, w, y):
        return False
    d = w.shape[0]
    rotate(rows, rows[d], 0, d, math.sqrt(forgetting))
    if ring.shape[0] > 0:
        x = rows[d + 1]
        copy_measurement(x, w, y)
        slide(rows, centre, ring, x, steps, rho, forgetting, stride)
    if stride > 0 and steps % stride == 0:
        refill(rows, anchor, centre, steps, rho, stride, losses)
    return True


@compiled
def place(rows: Array, w: Array, y: Array) -> bool:
    """Copy the measurement into the first scratch row, if its shape and its numbers are fit."""
    d, n = w.shape[0], y.shape[0]
    if rows.shape[0] != d + 2 or rows.shape[1] != d + n:
        return False
    x = rows[d]
    copy_measurement(x, w, y)
    total = 0.0
    for j in range(x.shape[0]):
        total += abs(x[j])
    return total <= LARGEST


@compiled
def copy_measurement(x: Array, w: Array, y: Array) -> None:
    """x (d + n,) <- [w^T y^T]."""
    for j in range(w.shape[0]):
        x[j] = w[j]
    tail = x[w.shape[0] :]
    for j in range(y.shape[0]):
        tail[j] = y[j]


@compiled
def refill(
    rows: Array,
    anchor: Array,
    centre: Array,
    steps: int,
    rho: float,
    stride: int,
    losses: Array,
) -> None:
    """Give row i of the prior back what it lost since its last turn; i goes round with `steps`."""
    d = anchor.shape[0]
    turn = steps // stride - 1
    i = turn % d
    if i == 0:
        solve_anchor(rows, anchor)
    lost = losses[min(turn, d - 1)]
    if centre.shape[0] > 0:
        for j in range(centre.shape[1]):
            centre[i, j] += lost * (anchor[i, j] - centre[i, j])
    x = rows[d + 1]
    refill_row(x, anchor, i, math.sqrt(rho * lost))
    rotate(rows, x, i, d, 1.0)


@compiled
def refill_row(x: Array, anchor: Array, i: int, weight: float) -> None:
    """x (d + n,) <- weight [e_i | a_i]."""
    d = anchor.shape[0]
    for j in range(d):
        x[j] = 0.0
    x[i] = weight
    tail = x[d:]
    for j in range(anchor.shape[1]):
        tail[j] = weight * anchor[i, j]


@compiled
def solve_anchor(rows: Array, anchor: Array) -> None:
    """anchor (d, n) <- R^{-1} D."""
    d = anchor.shape[0]
    for i in range(d):
        for j in range(anchor.shape[1]):
            anchor[i, j] = rows[i, d + j]
    back_substitute(rows, anchor)
