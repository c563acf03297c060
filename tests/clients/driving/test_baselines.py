"""The laws that know the true state hold the pole, within their bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from koop_clients.mechanics.linearisation import linearise, stationary_gain
from koop_clients.mechanics.simulation import (
    Policy,
    Simulator,
    State,
    angle_between,
    hold,
    with_pole,
    without_drift,
)
from koop_clients.mechanics.systems import System, build_system
from koop_clients.sim_client.driving.baselines import pd_law, state_lqr_law


def drive(system: System, law: Policy, start: State, frames: int = 100) -> tuple[State, float]:
    """The state after that many frames, and the largest mean torque."""
    simulator, state, largest = Simulator(system), start, 0.0
    for number in range(frames):
        state, torque = simulator.frame(state, law, number)
        state, largest = without_drift(system, state), max(largest, abs(torque))
    return state, largest


@pytest.mark.parametrize("name", ["pendulum", "cartpole"])
@pytest.mark.parametrize("target", [0.0, 0.4, math.pi])
def test_lqr_of_the_true_state_reaches_every_target(name: str, target: float) -> None:
    system = build_system(name)
    law = state_lqr_law(system, target, 1e-3, 20.0)
    state, largest = drive(system, law, with_pole(system, target + 1.0))
    assert angle_between(state.q[system.pole], target) == pytest.approx(0.0, abs=1e-3)
    assert state.v[system.pole] == pytest.approx(0.0, abs=1e-3)
    assert largest <= 20.0


def test_lqr_balances_a_double_pendulum() -> None:
    system = build_system("double-pendulum")
    law = state_lqr_law(system, 0.0, 1e-3, 20.0)
    state, _ = drive(system, law, with_pole(system, 0.05))
    assert np.abs(state.q).max() < 1e-3


@pytest.mark.parametrize("name", ["pendulum", "cartpole"])
def test_pd_reaches_upright(name: str) -> None:
    system = build_system(name)
    state, largest = drive(system, pd_law(system, 0.0, 20.0), with_pole(system, 1.0))
    assert abs(state.q[system.pole]) < 0.01
    assert 10.0 < largest <= 20.0


def test_pd_takes_the_shorter_way() -> None:
    system = build_system("pendulum")
    state, _ = drive(system, pd_law(system, 0.0, 20.0), with_pole(system, 2 * math.pi - 0.5))
    assert state.q[system.pole] == pytest.approx(2 * math.pi, abs=0.01)


def test_the_linear_plant_predicts_a_small_motion() -> None:
    system = build_system("cartpole")
    plant = linearise(system, 0.3)
    before = with_pole(system, 0.301, 0.002)
    after, _ = Simulator(system).frame(before, hold(plant.torque + 0.01), 0)
    expected = plant.A @ plant.error(before) + plant.B * 0.01
    assert plant.error(without_drift(system, after)) == pytest.approx(expected, abs=1e-5)


def test_the_gain_solves_the_riccati_equation() -> None:
    plant = linearise(build_system("pendulum"), 0.0)
    Q, r = np.diag([1.0, 0.1]), 1e-3
    K = stationary_gain(plant, Q, r)
    closed = plant.A - np.outer(plant.B, K)
    assert np.abs(np.linalg.eigvals(closed)).max() < 1

    # Its cost, summed up naively; at the best gain no small change lowers it.
    def cost(gain: np.ndarray) -> float:
        x, total = np.array([1.0, -0.5]), 0.0
        for _ in range(400):
            u = -float(gain @ x)
            total += float(x @ Q @ x) + r * u * u
            x = plant.A @ x + plant.B * u
        return total

    assert all(cost(K) < cost(K + d) for d in 0.05 * np.vstack([np.eye(2), -np.eye(2)]))


def test_a_plant_that_no_torque_moves_is_told() -> None:
    plant = linearise(build_system("pendulum"), 0.0)
    still = type(plant)(plant.system, plant.rest, 0.0, plant.A, np.zeros(2))
    with pytest.raises(ValueError, match="no torque of the motor holds the pendulum"):
        stationary_gain(still, np.eye(2), 1.0)
