"""Plans, late plans, and what counts as having reached the target."""

from __future__ import annotations

import numpy as np
import pytest

from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import with_pole
from koop_clients.mechanics.systems import build_system
from koop_clients.queries import NO_REPLY, KoopClient, KoopError
from koop_clients.sim_client.arguments import DriveOptions
from koop_clients.sim_client.driving import Planner, lqr_query, planned_torque
from koop_clients.sim_client.outcome import angle_between, outcome
from koop_protocol import ErrorCode, LqrQuery, LqrReply


def plan(seq: int, *torques: float, status: str = "solved") -> LqrReply:
    return LqrReply("a", "0" * 16, seq, status, 0.0, 0.0, np.array(torques)[:, None])


@pytest.mark.parametrize(("seq", "torque"), [(4, 0.0), (5, 1.0), (6, 2.0), (7, 3.0), (8, 0.0)])
def test_a_plan_speaks_of_the_intervals_after_its_frame(seq: int, torque: float) -> None:
    assert planned_torque(plan(5, 1.0, 2.0, 3.0), seq) == torque


def test_without_a_plan_there_is_no_torque() -> None:
    assert planned_torque(None, 3) == 0.0


class Unreliable(KoopClient):
    """Answers with what it was given, in turn."""

    def __init__(self, *answers: LqrReply | KoopError) -> None:
        self.answers = list(answers)

    def lqr(self, trajectory: str, query: LqrQuery, *, timeout: float | None = None) -> LqrReply:
        assert (trajectory, query.horizon, timeout) == ("a", 3, 0.045)
        answer = self.answers.pop(0)
        if isinstance(answer, KoopError):
            raise answer
        return answer


def test_a_late_plan_is_bridged_by_the_last_one() -> None:
    late = KoopError(NO_REPLY, "nobody answered")
    client = Unreliable(plan(0, 1.0, 2.0, 3.0), late, late, late, plan(4, 9.0))
    planner = Planner(client, "a", LqrQuery(3, target_code=np.zeros(2)), 0.045)
    assert [planner.torque(seq) for seq in range(4)] == [1.0, 2.0, 3.0, 0.0]
    assert (planner.late, planner.standing) == (3, "the service does not answer")
    assert planner.torque(4) == 9.0
    assert (planner.late, planner.standing, len(planner.latencies)) == (3, "", 2)


def test_a_refusal_that_lasts_ends_the_drive() -> None:
    client = Unreliable(plan(0, 1.0), KoopError(ErrorCode.bad_target, "not of the stream's shape"))
    planner = Planner(client, "a", LqrQuery(3, target_code=np.zeros(2)), 0.045)
    assert planner.torque(0) == 1.0
    with pytest.raises(KoopError, match="not of the stream's shape"):
        planner.torque(1)


def test_a_plan_that_is_not_optimal_is_followed_and_told() -> None:
    client = Unreliable(plan(0, 1.0, status="max_iterations"))
    planner = Planner(client, "a", LqrQuery(3, target_code=np.zeros(2)), 0.045)
    assert planner.torque(0) == 1.0
    assert planner.standing == "max_iterations"


def test_the_question_shows_the_target() -> None:
    system = build_system("cartpole")
    query = lqr_query(system, DriveOptions(target="0.3", horizon=7, q=2.0, r=0.1, torque_bound=5.0))
    assert query.target_image is not None
    assert np.array_equal(query.target_image, Renderer(system)(with_pole(system, 0.3).q))
    assert (query.horizon, query.q, query.r) == (7, 2.0, 0.1)
    assert query.u_min is not None
    assert query.u_max is not None
    assert (query.u_min.tolist(), query.u_max.tolist()) == ([-5.0], [5.0])


def test_a_pole_that_settles_has_arrived() -> None:
    angles = [1.0, 0.5, 0.05, 0.2, *[0.04] * 50]
    found = outcome(angles, [3.0, -7.0] * 27, 0.0)
    assert found is not None
    assert found.success
    assert found.settled_after == pytest.approx(4 * 0.05)
    assert found.worst_error_at_end == pytest.approx(0.04)
    assert found.largest_torque == 7.0


def test_whole_turns_do_not_matter() -> None:
    found = outcome([2 * np.pi + 0.02] * 60, [0.0] * 60, 0.0)
    assert found is not None
    assert found.success
    assert found.settled_after == 0.0
    assert found.final_error == pytest.approx(0.02)


@pytest.mark.parametrize(
    "angles",
    [[0.0] * 39, [0.0] * 59 + [0.3], [0.0] * 25 + [0.3] + [0.0] * 34],
    ids=["too short", "left at the end", "left meanwhile"],
)
def test_a_pole_that_is_not_held_for_two_seconds_has_not_arrived(angles: list[float]) -> None:
    found = outcome(angles, [0.0] * len(angles), 0.0)
    assert found is not None
    assert not found.success


def test_a_pole_that_is_away_at_the_end_never_settled() -> None:
    found = outcome([0.0] * 59 + [0.3], [0.0] * 60, 0.0)
    assert found is not None
    assert found.settled_after is None


def test_without_a_drive_there_is_no_outcome() -> None:
    assert outcome([], [], 0.0) is None


def test_angles_differ_by_less_than_half_a_turn() -> None:
    assert angle_between(3 * np.pi, np.pi) == pytest.approx(0.0)
    assert angle_between(-3.0, 3.0) == pytest.approx(2 * np.pi - 6.0)
