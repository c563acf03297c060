"""One plan to an aim, by the method that the query names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from koop_protocol import ErrorCode, LqrQuery, ProtocolError
from koop_service.control.bounds import ControlBounds
from koop_service.control.condense import CondensedQP, condense
from koop_service.control.objective import LqrProblem
from koop_service.control.optimality import kkt_residual
from koop_service.control.policy import StationaryPolicy, stationary_policy
from koop_service.control.solve import QPSolution, solve_qp
from koop_service.prediction.model import LinearModel
from koop_service.serving.steering.aims import Aim

Array = NDArray[np.float64]

KEPT = 10
"""Frames that a gain serves: it takes twice as long to find as a plan, and changes slowly."""


@dataclass(frozen=True, eq=False)
class Departure:
    """Where a plan begins, `elapsed` frames after the one from which the aim's sequences count.

    history: codes (h, n) when its first control acts. last_control: (p,), what acts before that.
    """

    model: LinearModel
    history: Array
    last_control: Array
    elapsed: int


@dataclass(frozen=True, eq=False)
class Gain:
    """A policy towards `target` (n,), of the model as it was `elapsed` frames into the aim."""

    policy: StationaryPolicy
    target: Array
    elapsed: int

    def serves(self, target: Array, elapsed: int) -> bool:
        """Whether it is young enough, and the target still there."""
        return elapsed - self.elapsed < KEPT and np.array_equal(target, self.target)


def steer(
    aim: Aim, departure: Departure, last: QPSolution | None = None, since: int = 1
) -> QPSolution:
    """Controls (N, p) of eq. 13, which may start from the solution `since` frames ago.

    Raises ProtocolError for weights and bounds that contradict, and where no plan is finite.
    """
    return _finite(aim, solve_qp(_problem(aim, departure), last, since))


def follow(aim: Aim, departure: Departure, gain: Gain) -> QPSolution:
    """Controls (N, p) by the gain; its residual says how far from eq. 13 they are.

    Raises as `steer`.
    """
    qp, policy = _problem(aim, departure), replace(gain.policy, model=departure.model)
    u = policy.plan(departure.history, aim.query.horizon, departure.last_control)
    return _finite(aim, QPSolution(u, qp.cost(u), "solved", kkt_residual(qp, u.reshape(-1))))


def gain_of(aim: Aim, departure: Departure, last: Gain | None) -> Gain:
    """The last gain while it serves, else the present model's. Raises as `steer`."""
    query, target = aim.query, aim.targets(departure.elapsed)[0]
    if last is not None and last.serves(target, departure.elapsed):
        return last
    with _refusing(ErrorCode.bad_weights):
        policy = stationary_policy(departure.model, target, query.q, query.r, *aim.bounds)
    if policy is None:
        raise ProtocolError(
            ErrorCode.bad_weights,
            "no gain makes the present model stable under these weights",
            "a model that the controls can steer",
            "let the model see more frames, weight every unstable code in q, or use method 'qp'",
        )
    return Gain(policy, target, departure.elapsed)


def _problem(aim: Aim, departure: Departure) -> CondensedQP:
    """What `build_lqr` builds; but weights and bounds that contradict are told apart."""
    model, query, last_control = departure.model, aim.query, departure.last_control
    targets, known = aim.targets(departure.elapsed), aim.known(departure.elapsed)
    horizon, end = query.horizon, "riccati" if isinstance(query.qf, str) else query.qf
    if not np.isfinite(departure.history).all():
        raise _unstable(query)
    with _refusing(ErrorCode.bad_weights):
        problem = LqrProblem.parse(
            model, departure.history, targets, horizon, query.q, query.r, end, known
        )
    with _refusing(ErrorCode.bad_bounds):
        bounds = ControlBounds.parse(horizon, model.control_size, *aim.bounds, last_control, known)
    return condense(problem, bounds)


def _finite(aim: Aim, found: QPSolution) -> QPSolution:
    if not np.isfinite([found.cost, found.kkt_residual]).all():
        raise _unstable(aim.query)
    return found


@contextmanager
def _refusing(code: ErrorCode) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ProtocolError(code, str(error)) from error


def _unstable(query: LqrQuery) -> ProtocolError:
    return ProtocolError(
        ErrorCode.bad_horizon,
        f"the present model is unstable: over {query.horizon} steps the cost overflows",
        "a cost that is a finite number",
        "ask for a shorter horizon, or let the model see more frames",
    )
