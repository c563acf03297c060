"""Plans from frame to frame, on a known linear model."""

from __future__ import annotations

import numpy as np
import pytest

from koop_protocol import ErrorCode, LqrQuery, ProtocolError
from koop_service.control.problem import build_lqr
from koop_service.control.solve import solve_qp
from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import rollout
from koop_service.serving.steering.aims import Aim
from koop_service.serving.steering.courses import Course, Schedule
from koop_service.serving.steering.planning import KEPT

MODEL = LinearModel(np.array([[1.0, 0.1], [0.3, 1.0]]), np.array([[0.0], [0.1]]), np.zeros(2))
BOUND = np.ones(1) * 4.0


def aim(**changes: object) -> Aim:
    options = {"horizon": 8, "target_code": np.zeros(2), "r": 0.1, "u_min": -BOUND, "u_max": BOUND}
    query = LqrQuery(**{**options, **changes})
    return Aim(query, np.atleast_2d(query.target_code))


def course(seq: int = 10, held: float = 0.0, **changes: object) -> Course:
    return Course(aim(**changes), seq, Schedule(seq - 1, np.array([held])))


def test_the_newest_plan_counts_and_its_last_row_stays():
    schedule = Schedule(4, np.array([9.0]))
    assert schedule.between(3, 6).ravel().tolist() == [9.0, 9.0, 9.0]
    schedule.replace(5, 7, np.array([[1.0], [2.0]]))
    assert schedule.between(5, 10).ravel().tolist() == [9.0, 9.0, 1.0, 2.0, 2.0]
    schedule.replace(6, 8, np.array([[3.0], [4.0]]))
    assert schedule.between(6, 11).ravel().tolist() == [9.0, 1.0, 3.0, 4.0, 4.0]


def test_a_plan_is_that_of_build_lqr():
    history = np.array([[0.5, -0.2]])
    expected = solve_qp(build_lqr(MODEL, history, np.zeros(2), 8, 1.0, 0.1, -BOUND, BOUND))
    plan = course().plan(MODEL, history, 10)
    np.testing.assert_array_equal(plan.solution.u, expected.u)
    assert plan.start == 10


@pytest.mark.parametrize("method", ["qp", "gain"])
def test_with_a_delay_it_plans_from_where_the_promised_controls_lead(method):
    """Undisturbed, the delayed loop goes where each plan said that it would go."""
    delayed = course(held=2.0, delay=3, qf="riccati", method=method)
    code = np.array([[0.5, -0.2]])
    applied = {}
    for seq in range(10, 40):
        plan = delayed.plan(MODEL, code, seq)
        assert plan.start == seq + 3
        applied[plan.start] = plan.solution.u[0]
        ahead = [applied.get(k, np.array([2.0])) for k in range(seq, seq + 3)]
        np.testing.assert_allclose(plan.history, rollout(MODEL, code, np.array(ahead))[-1:])
        code = rollout(MODEL, code, ahead[0][None])
    assert np.abs(code).max() < 0.1


def test_rates_hold_from_one_command_to_the_next():
    rate, code = np.array([0.25]), np.array([[1.5, 0.0]])
    limited, last = course(held=1.0, du_min=-rate, du_max=rate, delay=1), 1.0
    rng = np.random.default_rng(0)
    for seq in range(10, 40):
        u = limited.plan(MODEL, code, seq).solution.u[0, 0]
        assert abs(u - last) <= 0.25 + 1e-12
        last, code = u, code + 0.3 * rng.normal(size=(1, 2))


def test_bounds_out_of_the_rates_reach_are_refused():
    with pytest.raises(ProtocolError, match="allow a faster change") as caught:
        course(held=9.0, du_min=np.array([-1.0])).plan(MODEL, np.zeros((1, 2)), 10)
    assert caught.value.code == ErrorCode.bad_bounds


def test_a_sequence_counts_from_the_first_frame():
    """At a frame k later the plan is that towards what is left of the sequence."""
    way = np.column_stack([np.linspace(0.0, 1.0, 12), np.zeros(12)])
    moving, code = course(target_code=way), np.array([[0.1, 0.0]])
    for k in (0, 1, 5, 20):
        found = moving.plan(MODEL, code, 10 + k).solution.u
        alone = course(target_code=way[min(k, 11) :]).plan(MODEL, code, 10).solution.u
        np.testing.assert_allclose(found, alone, atol=1e-8)


def test_the_next_plan_starts_from_the_last_one():
    warm, code = course(), np.array([[0.5, -0.2]])
    first = warm.plan(MODEL, code, 10)
    assert not first.solution.warm
    assert warm.plan(MODEL, rollout(MODEL, code, first.solution.u[:1]), 11).solution.warm


@pytest.mark.parametrize(
    ("model", "changes", "code"),
    [
        (MODEL, {"r": np.array([[-1.0]])}, None),
        (LinearModel(1e200 * MODEL.A, MODEL.B, MODEL.c), {}, ErrorCode.bad_horizon),
        (LinearModel(1e200 * MODEL.A, MODEL.B, MODEL.c), {"delay": 3}, ErrorCode.bad_horizon),
    ],
)
@pytest.mark.filterwarnings("error")
def test_without_a_plan_the_rest_of_the_last_one_is_left(model, changes, code):
    if code is None:
        with pytest.raises(ProtocolError):
            aim(**changes)
        return
    going = course(**changes)
    last = going.plan(MODEL, np.array([[0.5, -0.2]]), 10).solution.u
    with pytest.raises(ProtocolError) as caught:
        going.plan(model, np.array([[0.5, -0.2]]), 12)
    assert caught.value.code == code
    rest = going.rest(12)
    assert rest.shape == last.shape
    np.testing.assert_array_equal(rest, np.concatenate([last[2:], last[-1:], last[-1:]]))


def test_a_gain_serves_some_frames_and_then_the_present_model_has_the_word():
    lost, code = LinearModel(2 * MODEL.A, 0 * MODEL.B, MODEL.c), np.array([[0.5, -0.2]])
    going = course(method="gain")
    first = going.plan(MODEL, code, 10).solution.u[0]
    np.testing.assert_array_equal(going.plan(lost, code, 10 + KEPT - 1).solution.u[0], first)
    with pytest.raises(ProtocolError, match="no gain") as caught:
        going.plan(lost, code, 10 + KEPT)
    assert caught.value.code == ErrorCode.bad_weights


def test_a_gain_goes_where_the_target_goes():
    way, code = np.linspace([0.0, 0.0], [1.0, 1.0], 12), np.array([[0.5, -0.2]])
    moving = course(method="gain", target_code=way)
    moving.plan(MODEL, code, 10)
    found = moving.plan(MODEL, code, 15).solution.u
    alone = course(method="gain", target_code=way[5:]).plan(MODEL, code, 10).solution.u
    np.testing.assert_allclose(found[0], alone[0], atol=1e-9)
