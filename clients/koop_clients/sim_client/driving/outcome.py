"""What became of a pole, by the simulator's own angles. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from koop_clients.mechanics.simulation import FRAME_INTERVAL, angle_between

NEAR = 0.1  # rad, what counts as being at the target
SLOW = 0.5  # rad/s, and as resting there
RATE_WEIGHT, TORQUE_WEIGHT = 0.1, 1e-3  # of the cost, s^2 and rad^2/(N m)^2
_LAST = round(2.0 / FRAME_INTERVAL)  # frames at the end, over which the pole must stay there


@dataclass(frozen=True)
class Outcome:
    """What a drive achieved.

    Attributes:
        success: whether the pole was within 0.1 rad of the target, and no faster than 0.5 rad/s,
            all through the last 2 s.
        cost: sum over the frames of error^2 + 0.1 rate^2 + 0.001 torque^2.
        settled_after: time after which it stayed so [s]; None if it never did.
        final_error: angle from the target at the end [rad].
        final_rate: its rate there [rad/s].
        worst_error_at_end: largest angle from the target over the last 2 s [rad].
        largest_torque: [N m].
    """

    success: bool
    cost: float
    settled_after: float | None
    final_error: float
    final_rate: float
    worst_error_at_end: float
    largest_torque: float


def outcome(
    angles: Sequence[float], rates: Sequence[float], torques: Sequence[float], target: float
) -> Outcome | None:
    """Judge a drive by the pole's angle [rad] and rate [rad/s] at each frame, and the torque [N m]
    after it; None where there is none."""
    if not angles:
        return None
    errors = np.abs(angle_between(np.asarray(angles), target))
    speeds, efforts = np.abs(np.asarray(rates)), np.abs(np.asarray(torques))
    there = (errors <= NEAR) & (speeds <= SLOW)
    away = np.flatnonzero(~there)
    settled = int(away[-1]) + 1 if len(away) else 0
    cost = np.sum(errors**2) + RATE_WEIGHT * np.sum(speeds**2) + TORQUE_WEIGHT * np.sum(efforts**2)
    return Outcome(
        success=bool(there[-_LAST:].all()) and len(errors) >= _LAST,
        cost=float(cost),
        settled_after=settled * FRAME_INTERVAL if settled < len(errors) else None,
        final_error=float(errors[-1]),
        final_rate=float(speeds[-1]),
        worst_error_at_end=float(errors[-_LAST:].max()),
        largest_torque=float(efforts.max(initial=0.0)),
    )
