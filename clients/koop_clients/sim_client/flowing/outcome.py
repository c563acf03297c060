"""What became of a wake, by the simulator's own velocity behind the cylinder. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CALM = 0.1
"""Share of the natural swing that counts as a calm wake."""

PROMPT = 150
"""Frames within which it is to be calm."""

_LAST = 20  # frames at the end: more than two periods


@dataclass(frozen=True)
class FlowOutcome:
    """What a drive achieved.

    Attributes:
        success: whether |v| fell below a tenth of its natural swing within 150 frames, for good.
        natural: largest |v| behind a cylinder at rest [U].
        calmed_after: frames after which |v| stayed below a tenth of that; None if it never did.
        swing_at_end: largest |v| in the last 20 frames [U].
        largest_rotation: [U/D].
        effort: root mean square of the rotation [U/D].
    """

    success: bool
    natural: float
    calmed_after: int | None
    swing_at_end: float
    largest_rotation: float
    effort: float


def outcome(
    probes: Sequence[float], rotations: Sequence[float], natural: float
) -> FlowOutcome | None:
    """Judge a drive by the transverse velocity [U] at each frame and the rotation [U/D] after it;
    None where there is none."""
    if not len(probes):
        return None
    swings, turns = np.abs(np.asarray(probes)), np.asarray(rotations)
    loud = np.flatnonzero(swings >= CALM * natural)
    calmed = int(loud[-1]) + 1 if len(loud) else 0
    settled = len(swings) - calmed >= _LAST  # v passes through zero twice a period
    return FlowOutcome(
        success=settled and calmed <= PROMPT,
        natural=natural,
        calmed_after=calmed if settled else None,
        swing_at_end=float(swings[-_LAST:].max()),
        largest_rotation=float(np.abs(turns).max()),
        effort=float(np.sqrt(np.mean(turns**2))),
    )
