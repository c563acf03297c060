"""What became of the pole, by the simulator's own angles. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from koop_clients.mechanics.simulation import FRAME_INTERVAL

NEAR = 0.1  # rad, what counts as being at the target
_LAST = round(2.0 / FRAME_INTERVAL)  # frames at the end, over which the pole must stay near


@dataclass(frozen=True)
class Outcome:
    """What a drive achieved.

    Attributes:
        final_error: angle from the target at the end [rad].
        worst_error_at_end: largest angle from the target over the last 2 s [rad].
        settled_after: time after which the pole stayed within 0.1 rad [s]; None if it never did.
        largest_torque: [N m].
        success: whether it was within 0.1 rad all through the last 2 s.
    """

    final_error: float
    worst_error_at_end: float
    settled_after: float | None
    largest_torque: float
    success: bool


def outcome(angles: Sequence[float], torques: Sequence[float], target: float) -> Outcome | None:
    """Judge a drive by the pole's angle [rad] at each frame and the torque [N m] after it."""
    if not angles:
        return None
    errors = np.abs(angle_between(np.asarray(angles), target))
    away = np.flatnonzero(errors > NEAR)
    settled = int(away[-1]) + 1 if len(away) else 0
    worst = float(errors[-_LAST:].max())
    return Outcome(
        final_error=float(errors[-1]),
        worst_error_at_end=worst,
        settled_after=settled * FRAME_INTERVAL if settled < len(errors) else None,
        largest_torque=float(np.abs(np.asarray(torques)).max(initial=0.0)),
        success=worst <= NEAR and len(errors) >= _LAST,
    )


def angle_between(angle: np.ndarray | float, target: float) -> np.ndarray:
    """Signed difference in [-pi, pi) [rad]."""
    return (np.asarray(angle) - target + np.pi) % (2 * np.pi) - np.pi
