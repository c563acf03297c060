"""What counts as having reached the target, and what it costs."""

from __future__ import annotations

import numpy as np
import pytest

from koop_clients.mechanics.simulation import angle_between
from koop_clients.sim_client.driving.outcome import Outcome, outcome


def judged(angles: list[float], rates: list[float] | None = None) -> Outcome:
    found = outcome(angles, rates or [0.0] * len(angles), [0.0] * len(angles), 0.0)
    assert found is not None
    return found


def test_a_pole_that_settles_has_arrived() -> None:
    angles = [1.0, 0.5, 0.05, 0.2, *[0.04] * 50]
    found = outcome(angles, [0.0] * 54, [3.0, -7.0] * 27, 0.0)
    assert found is not None
    assert found.success
    assert found.settled_after == pytest.approx(4 * 0.05)
    assert found.worst_error_at_end == pytest.approx(0.04)
    assert found.largest_torque == 7.0


def test_whole_turns_do_not_matter() -> None:
    found = judged([2 * np.pi + 0.02] * 60)
    assert found.success
    assert found.settled_after == 0.0
    assert found.final_error == pytest.approx(0.02)


@pytest.mark.parametrize(
    "angles",
    [[0.0] * 39, [0.0] * 59 + [0.3], [0.0] * 25 + [0.3] + [0.0] * 34],
    ids=["too short", "left at the end", "left meanwhile"],
)
def test_a_pole_that_is_not_held_for_two_seconds_has_not_arrived(angles: list[float]) -> None:
    assert not judged(angles).success


def test_a_pole_that_swings_through_has_not_arrived() -> None:
    still = [0.0] * 60
    assert judged(still, [0.5] * 60).success
    assert not judged(still, [0.0] * 30 + [-0.6] + [0.0] * 29).success
    assert judged(still, [0.0] * 30 + [-0.6] + [0.0] * 29).settled_after == pytest.approx(31 * 0.05)


def test_a_pole_that_is_away_at_the_end_never_settled() -> None:
    assert judged([0.0] * 59 + [0.3]).settled_after is None


def test_the_cost_is_that_of_the_contract() -> None:
    found = outcome([1.2, -0.8], [2.0, -3.0], [10.0, -20.0], 0.2)
    assert found is not None
    assert found.cost == pytest.approx(1.0 + 1.0 + 0.1 * (4 + 9) + 1e-3 * (100 + 400))


def test_without_a_drive_there_is_no_outcome() -> None:
    assert outcome([], [], [], 0.0) is None


def test_angles_differ_by_less_than_half_a_turn() -> None:
    assert angle_between(3 * np.pi, np.pi) == pytest.approx(0.0)
    assert angle_between(-3.0, 3.0) == pytest.approx(2 * np.pi - 6.0)
