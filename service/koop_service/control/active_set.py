"""From a good guess to the exact solution: who sits on which bound, then linear equations.

The primal-dual active set method (Hintermueller, Ito, Kunisch 2002). A bound is active where the
guess, moved by its multiplier, is beyond it; with those held, the rest is linear. It need not
converge: the caller judges each answer by its KKT residual.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .condense import CondensedQP
from .optimality import Candidate, assess, within

Array = NDArray[np.float64]
_Indices = NDArray[np.intp]
_Flags = NDArray[np.bool_]

# Relative to the diagonal of H: multipliers of redundant rate bounds stay where they are (a
# proximal term), instead of making the equations singular.
_PROXIMAL = 1e-12


class Guess(NamedTuple):
    """u (N*p,) and multipliers: `bounds` (N*p,) of u's, `rates` like `qp.changes(u)` of its rates.

    All positive on an upper bound, negative on a lower one. u may be a little inadmissible.
    """

    u: Array
    bounds: Array
    rates: Array


def guess_at(qp: CondensedQP, u: Array, rates: Array) -> Guess:
    """The multipliers of u's bounds are what balances the gradient."""
    return Guess(u, -(qp.gradient(u) + qp.pull(rates)), rates)


def refine(qp: CondensedQP, guess: Guess, rounds: int, enough: float) -> Candidate:
    """The best of up to `rounds` steps from the guess and, if none is `enough`, of the guess.

    Ends at a residual of `enough`, and where a step does not lessen it: it would hardly come back.
    """
    start, best = guess, None
    for _ in range(rounds):
        try:
            guess = _step(qp, guess)
        except np.linalg.LinAlgError:
            break
        found = assess(qp, guess.u, guess.rates)
        if best is not None and not found.residual < best.residual:
            break
        best = found
        if best.residual <= enough:
            return best
    first = assess(qp, start.u, start.rates)
    if best is None or np.isnan(best.residual) or first.residual < best.residual:
        return first
    return best


def _step(qp: CondensedQP, guess: Guess) -> Guess:
    """Hold what the guess has on bounds, solve for the others and for the rates' multipliers."""
    moved = guess.u + guess.bounds / np.diagonal(qp.H)
    is_free = (moved > qp.lower) & (moved < qp.upper)
    u = np.where(is_free, guess.u, within(qp, moved))
    free, rates = np.flatnonzero(is_free), guess.rates
    if len(rates):
        u, rates = _solve_tied(qp, guess, u, is_free)
    else:
        u[free] -= np.linalg.solve(qp.H[np.ix_(free, free)], qp.gradient(u)[free])
    balance = -(qp.gradient(u) + qp.pull(rates))
    return Guess(u, np.where(is_free, 0.0, balance), rates)


def _solve_tied(qp: CondensedQP, guess: Guess, u: Array, is_free: _Flags) -> tuple[Array, Array]:
    """u and the rates' multipliers, where the changes that the guess has on a bound stay there.

    A change between two held controls keeps its multiplier: it ties nothing that is free.
    """
    p = qp.control_size
    moved = qp.changes(guess.u) + guess.rates / np.diagonal(qp.H)[p:]
    above, below = moved >= qp.rate_upper, moved <= qp.rate_lower
    rates = np.where(above | below, guess.rates, 0.0)
    rows = np.flatnonzero((above | below) & (is_free[p:] | is_free[:-p]))
    missing = (np.where(above, qp.rate_upper, qp.rate_lower) - qp.changes(u))[rows]
    free, old = np.flatnonzero(is_free), rates[rows]
    rates[rows] = 0.0
    slope = (qp.gradient(u) + qp.pull(rates))[free]
    step, rates[rows] = _saddle_point(qp, free, rows, slope, missing, old)
    u[free] += step
    return u, rates


def _saddle_point(
    qp: CondensedQP, free: _Indices, rows: _Indices, slope: Array, missing: Array, old: Array
) -> tuple[Array, Array]:
    """Step x and multipliers y: H x + C^T y = -slope, C x = missing; y near `old` if not unique."""
    C = qp.rate_rows()[np.ix_(rows, free)]
    proximal = _PROXIMAL / float(np.diagonal(qp.H).mean())
    k, size = len(free), len(free) + len(rows)
    system = np.zeros((size, size))
    system[:k, :k], system[:k, k:], system[k:, :k] = qp.H[np.ix_(free, free)], C.T, C
    system[range(k, size), range(k, size)] = -proximal
    found = np.linalg.solve(system, np.concatenate([-slope, missing - proximal * old]))
    found = np.asarray(found, dtype=np.float64)
    return found[:k], found[k:]
