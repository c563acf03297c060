"""The first plan of a query: whether there should be one, and what to tell its caller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koop_protocol import LqrQuery, LqrReply
from koop_service.control.certificate import Certificate
from koop_service.prediction.model import LinearModel
from koop_service.serving.steering.aims import MAX_PLANNED, Aim, aim_of
from koop_service.serving.steering.courses import Course, Plan, Schedule
from koop_service.serving.steering.fitness import Verdict, judge
from koop_service.serving.trajectories.forecasts import forecast
from koop_service.serving.trajectories.trajectory import Trajectory

Array = NDArray[np.float64]

_LARGEST = 1e300
"""Stands for infinity, which does not travel: the score of a control without any noise."""


@dataclass(frozen=True, eq=False)
class Outset:
    """reply: for the caller. model: the present one. course: how to go on, None where unfit."""

    reply: LqrReply
    model: LinearModel
    course: Course | None


def set_out(
    trajectory: Trajectory,
    query: LqrQuery,
    schedule: Schedule | None = None,
    most: int = MAX_PLANNED,
) -> Outset:
    """Judge the model, and plan where it is fit or the query forces it.

    schedule: what was promised so far for coming intervals; None: the last control stays.
    most: numbers that its control sequence may have.
    Raises ProtocolError for a query that does not fit the trajectory or that nothing satisfies.
    """
    history, model, seq = trajectory.recent_codes(), trajectory.model(), trajectory.last_seq
    aim = aim_of(trajectory, query, most)
    verdict = judge(model, trajectory.posterior(), trajectory.settings, history, aim)
    if not (verdict.fit or query.force):
        return Outset(_reply(trajectory, aim, verdict, _refusal(verdict)), model, None)
    course = Course(aim, seq, schedule or Schedule(seq - 1, trajectory.last_control()))
    found = _offer(trajectory, model, query, course.plan(model, history, seq))
    return Outset(_reply(trajectory, aim, verdict, found), model, course)


def _reply(trajectory: Trajectory, aim: Aim, verdict: Verdict, outcome: dict[str, Any]) -> LqrReply:
    return LqrReply(
        trajectory.name,
        trajectory.epoch,
        trajectory.last_seq,
        start=trajectory.last_seq + aim.query.delay,
        target_error=aim.error,
        fit=verdict.fit,
        reasons=verdict.reasons,
        warnings=verdict.warnings,
        **_numbers(verdict.certificate),
        **outcome,
    )


def _refusal(verdict: Verdict) -> dict[str, Any]:
    return {"status": "unfit", "cost": 0.0, "kkt_residual": 0.0, "probing": verdict.probing}


def _offer(
    trajectory: Trajectory, model: LinearModel, query: LqrQuery, plan: Plan
) -> dict[str, Any]:
    """The controls, and what they should lead to as far as that is asked for."""
    found = plan.solution
    offer: dict[str, Any] = {
        "status": found.status,
        "cost": found.cost,
        "kkt_residual": found.kkt_residual,
        "controls": found.u,
    }
    codes = forecast(model, plan.history, found.u) if query.returns else None
    if codes is not None and "codes" in query.returns:
        offer["codes"] = codes
    if codes is not None and "frames" in query.returns:
        offer["frames"] = trajectory.show(codes)
    return offer


def _numbers(certificate: Certificate) -> dict[str, Any]:
    """The certificate as it travels, without infinite numbers and empty arrays."""
    modes = [
        (mode.eigenvalue.real, mode.eigenvalue.imag, mode.margin, mode.score)
        for mode in certificate.modes
    ]
    judged = bool(np.isfinite(certificate.band))
    return {
        "modes": _sendable(np.array(modes)) if modes else None,
        "scores": _sendable(certificate.scores),
        "information": _sendable(certificate.information),
        "residual": certificate.residual if judged else 0.0,
        "band": certificate.band if judged else 0.0,
    }


def _sendable(numbers: Array) -> Array:
    return np.minimum(numbers, _LARGEST)
