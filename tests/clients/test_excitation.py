"""The paper's equations 14 and 15, and torques that hold still for a frame."""

from __future__ import annotations

import numpy as np
import pytest

from koop_clients.mechanics.excitation import (
    TORQUE_BOUND,
    Passage,
    Reference,
    Rest,
    Tracking,
    excitation,
)
from koop_clients.mechanics.simulation import FRAME_INTERVAL, STEP, Simulator, State, with_pole
from koop_clients.mechanics.systems import SYSTEMS, build_system


def test_a_reference_is_a_sum_of_sinusoids_with_its_own_derivative() -> None:
    amplitude, rate, phase = np.array([0.5, 0.2, 0.1]), np.array([1.0, 2.0, 3.0]), np.arange(3.0)
    reference = Reference(amplitude, rate, phase, centre=0.3)
    angle, slope = reference(0.7)
    terms = zip(amplitude, rate, phase, strict=True)
    assert angle == pytest.approx(0.3 + sum(a * np.sin(w * 0.7 + f) for a, w, f in terms))
    step = 1e-6
    assert slope == pytest.approx((reference(0.7 + step)[0] - angle) / step, abs=1e-4)


def test_a_passage_stays_leaves_and_arrives() -> None:
    passage = Passage(Rest(3.0), Rest(1.0), begin=2.0, duration=4.0)
    assert passage(0.0) == (3.0, 0.0)
    assert passage(4.0) == (2.0, pytest.approx(-0.75))
    assert passage(9.0) == (1.0, 0.0)


def test_a_passage_s_rate_is_its_angle_s_derivative_also_between_moving_references() -> None:
    wave = Reference(np.array([0.4]), np.array([2.0]), np.array([0.3]))
    passage = Passage(wave, Passage(Rest(2.0), wave, 1.0, 0.5), begin=0.5, duration=1.5)
    for time in np.linspace(0.2, 2.4, 12):
        slope = (passage(time + 1e-6)[0] - passage(time - 1e-6)[0]) / 2e-6
        assert passage(time)[1] == pytest.approx(slope, rel=1e-5, abs=1e-8)


def test_tracking_is_proportional_and_derivative() -> None:
    system = build_system("cartpole")
    policy = Tracking(system, Rest(0.5), gains=(10.0, 2.0)).policy()
    state = State(np.array([9.0, 0.7]), np.array([9.0, 0.3]))
    assert policy(0, 0, state) == pytest.approx(-10.0 * 0.2 - 2.0 * 0.3)


def test_the_paper_s_gains_are_100_and_10() -> None:
    system = build_system("pendulum")
    policy, reference = excitation(system, "paper", np.random.default_rng(0))
    assert reference is not None
    number, step = 7, 3
    angle, rate = reference(number * FRAME_INTERVAL + step * STEP)
    state = State(np.array([angle + 0.05]), np.array([rate - 0.2]))
    assert policy(number, step, state) == pytest.approx(-100.0 * 0.05 + 10.0 * 0.2)


def test_torques_are_bounded() -> None:
    system = build_system("pendulum")
    policy, _ = excitation(system, "paper", np.random.default_rng(0))
    assert policy(0, 0, State(np.array([50.0]), np.zeros(1))) == -TORQUE_BOUND
    assert policy(0, 0, State(np.array([-50.0]), np.zeros(1))) == TORQUE_BOUND


def test_free_is_no_torque_at_all() -> None:
    policy, reference = excitation(build_system("pendulum"), "free", np.random.default_rng(0))
    assert reference is None
    assert policy(3, 2, State(np.ones(1), np.ones(1))) == 0.0


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_soft_torque_is_held_for_each_frame(name: str) -> None:
    system = build_system(name)
    policy, reference = excitation(system, "soft", np.random.default_rng(1))
    assert reference is not None
    seen: dict[int, set[float]] = {}

    def spy(number: int, step: int, state: State) -> float:
        torque = policy(number, step, state)
        seen.setdefault(number, set()).add(torque)
        return torque

    simulator, state = Simulator(system), with_pole(system, *reference(0.0))
    for number in range(20):
        state, mean = simulator.frame(state, spy, number)
        (torque,) = seen[number]
        assert torque == pytest.approx(mean)
    assert len(set().union(*seen.values())) == 20


def test_a_rewound_plant_gets_the_same_torques() -> None:
    system = build_system("cartpole")
    policy, _ = excitation(system, "soft", np.random.default_rng(2))
    simulator, start = Simulator(system), with_pole(system, 0.4)
    first = simulator.frame(start, policy, 11)
    simulator.frame(first[0], policy, 12)
    again = simulator.frame(start, policy, 11)
    assert np.array_equal(first[0].q, again[0].q)
    assert first[1] == again[1]


def test_hanging_references_swing_around_the_hanging_pole() -> None:
    rng = np.random.default_rng(3)
    _, reference = excitation(build_system("cartpole"), "soft-hanging", rng)
    assert reference is not None
    assert reference.centre == pytest.approx(np.pi)
