"""When a command acts."""

from __future__ import annotations

import math

import pytest

from koop_clients.mechanics.simulation import STEPS_PER_FRAME
from koop_clients.sim_client.driving.timing import Timing


def first_step(timing: Timing, seq: int, lag: float) -> tuple[int, int]:
    """(interval, step) at which the command from frame `seq` begins to act."""
    return next(
        (number, step)
        for number in range(seq, seq + 100)
        for step in range(STEPS_PER_FRAME)
        if timing.is_there(seq, lag, number, step)
    )


@pytest.mark.parametrize(
    ("timing", "lag", "expected"),
    [
        (Timing(1.0), 0.0, (7, 0)),
        (Timing(1.0), 0.011, (7, 3)),
        (Timing(1.0), 0.015, (7, 3)),
        (Timing(1.0), 0.049, (8, 0)),
        (Timing(1.0), 0.120, (9, 4)),
        (Timing(4.0), 0.010, (7, 8)),
        (Timing(math.inf), 5.0, (7, 0)),
        (Timing(1.0, 0.1), 0.011, (9, 3)),
        (Timing(math.inf, 0.06), 5.0, (8, 2)),
    ],
)
def test_a_command_acts_from_the_first_step_after_it_came(
    timing: Timing, lag: float, expected: tuple[int, int]
) -> None:
    assert first_step(timing, 7, lag) == expected


@pytest.mark.parametrize(
    ("timing", "lag", "frames"),
    [
        (Timing(1.0), 0.010, 0),
        (Timing(1.0), 0.030, 1),
        (Timing(math.inf), 0.030, 0),
        (Timing(math.inf, 0.1), 0.030, 2),
        (Timing(1.0, 0.06), 0.010, 1),
        (Timing(2.0, 0.1), 0.015, 3),
    ],
)
def test_the_delay_is_told_in_frames(timing: Timing, lag: float, frames: int) -> None:
    assert timing.frames(lag) == frames
