"""Judging controls by the conditions of optimality (KKT), whoever found them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .condense import CondensedQP

Array = NDArray[np.float64]


class Candidate(NamedTuple):
    """Admissible controls u (N*p,), the slope there, and how far from optimal they are.

    rates: multipliers of the rate bounds. slope: (N*p,) gradient with their pull, what is left to
    the bounds on u. residual: see `kkt_residual`.
    """

    u: Array
    rates: Array
    slope: Array
    residual: float


def kkt_residual(qp: CondensedQP, u: Array, rates: Array | None = None) -> float:
    """How far the flat u (N*p,) is from optimal, relative to the largest control; 0 if it is.

    rates: multipliers of the rate bounds, like `qp.changes(u)`; positive on an upper bound. The
    bounds on u need none: given the rates' pull, the KKT conditions hold exactly where the step
    -gradient / diag(H), cut off at the bounds, leads nowhere, and where moving the changes by their
    multipliers, cut off at theirs, does not either. The residual is the largest such step over the
    largest control in play. Wrong multipliers can only make it larger: no solver is believed.
    """
    rates = np.zeros(len(qp.rate_lower)) if rates is None else rates
    return _residual(qp, u, rates, qp.gradient(u) + qp.pull(rates))


def assess(qp: CondensedQP, u: Array, rates: Array) -> Candidate:
    """Controls made admissible, and how far from optimal that leaves them."""
    u = admissible(qp, u)
    slope = qp.gradient(u) + qp.pull(rates)
    return Candidate(u, rates, slope, _residual(qp, u, rates, slope))


def _residual(qp: CondensedQP, u: Array, rates: Array, slope: Array) -> float:
    scale = 1.0 / np.diagonal(qp.H)
    step = float(np.abs(u - within(qp, u - slope * scale)).max())
    if len(rates):
        changes = qp.changes(u)
        moved = changes + rates * scale[qp.control_size :]
        off = changes - np.minimum(np.maximum(moved, qp.rate_lower), qp.rate_upper)
        step = float(np.maximum(step, np.abs(off).max()))  # NaN must come through
    reach = max(float(np.abs(qp.g * scale).max()), float(np.abs(u).max()))
    return step / reach if reach > 0.0 else 0.0


def within(qp: CondensedQP, u: Array) -> Array:
    """u cut off at its bounds, whatever the rates."""
    return np.minimum(np.maximum(u, qp.lower), qp.upper)


def admissible(qp: CondensedQP, u: Array) -> Array:
    """u within bounds and rates, to rounding: each step cut off at what the one before allows.

    There is always something left, since the bounds hold still and a rate of zero is allowed.
    """
    u = within(qp, u)
    changes = qp.changes(u)
    if not len(changes):
        return u
    slack = 1e-13 * np.abs(u).max()
    if (changes >= qp.rate_lower - slack).all() and (changes <= qp.rate_upper + slack).all():
        return u
    p = qp.control_size
    for t in range(p, len(u), p):
        before, now, rate = u[t - p : t], slice(t, t + p), slice(t - p, t)
        low = np.maximum(qp.lower[now], before + qp.rate_lower[rate])
        high = np.minimum(qp.upper[now], before + qp.rate_upper[rate])
        u[now] = np.minimum(np.maximum(u[now], low), high)
    return u
