"""Plans in time: delays are exact on a linear system, and a missing command is the last plan's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.control.plan import rest_of_plan, roll_forward
from koop_service.control.problem import build_lqr
from koop_service.control.solve import solve_qp
from koop_service.prediction.rollout import rollout

from .systems import closed_loop, pendulum, random_model


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 3),
    st.integers(1, 2),
    st.integers(0, 6),
    st.booleans(),
)
def test_the_delay_is_compensated_exactly(seed, h, p, delay, affine):
    rng = np.random.default_rng(seed)
    model = random_model(rng, 4, h, p, affine=affine)
    history, committed = rng.normal(size=(h, 4)), rng.normal(size=(delay, p))
    ahead = roll_forward(model, history, committed)
    later = rng.normal(size=(5, p))
    expected = rollout(model, history, np.concatenate([committed, later]))[delay:]
    np.testing.assert_allclose(rollout(model, ahead, later), expected, rtol=1e-9, atol=1e-9)


def test_with_compensation_the_delayed_pendulum_stands_without_it_falls():
    model, delay = pendulum(gravity=40.0), 3

    def last_angle(compensated):
        waiting = [np.zeros(1)] * delay

        def controller(history, _last, _t):
            start = roll_forward(model, history, np.stack(waiting)) if compensated else history
            waiting.append(solve_qp(build_lqr(model, start, np.zeros(2), 10, 1.0, 0.01)).u[0])
            return waiting.pop(0)

        return abs(closed_loop(model, np.array([[0.1, 0.0]]), controller, 80)[0][-1, 0])

    assert last_angle(compensated=True) < 1e-4
    assert last_angle(compensated=False) > 1.0


def test_the_rest_of_a_plan_then_its_last_control():
    plan = np.arange(8.0).reshape(4, 2)
    np.testing.assert_array_equal(rest_of_plan(plan, 0), plan)
    np.testing.assert_array_equal(rest_of_plan(plan, 2), plan[[2, 3, 3, 3]])
    np.testing.assert_array_equal(rest_of_plan(plan, 9), plan[[3, 3, 3, 3]])


def test_bad_arguments_say_what_was_wrong():
    with pytest.raises(ValueError, match="elapsed is -1"):
        rest_of_plan(np.zeros((3, 1)), -1)
    with pytest.raises(ValueError, match=r"plan has shape \(0, 1\)"):
        rest_of_plan(np.zeros((0, 1)), 1)
    model = random_model(np.random.default_rng(0))
    with pytest.raises(ValueError, match="controls has shape"):
        roll_forward(model, np.zeros((2, 8)), np.zeros((3, 2)))
    with pytest.raises(ValueError, match="history has shape"):
        roll_forward(model, np.zeros((1, 8)), np.zeros((0, 1)))
