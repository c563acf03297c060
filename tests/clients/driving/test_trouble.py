"""Kicks, noise and a change of mass act on the plant, and are not streamed."""

from __future__ import annotations

import numpy as np
import pytest

from koop_clients.mechanics.simulation import STEPS_PER_FRAME, hold, with_pole
from koop_clients.mechanics.systems import build_system
from koop_clients.sim_client.driving.trouble import disturbance, mass_change_frame
from koop_clients.sim_client.options import TroubleOptions
from koop_clients.sim_client.plant import Plant

SYSTEM = build_system("pendulum")


def test_a_kick_is_an_impulse() -> None:
    """0.1 N m s on a pendulum of m l^2 = 0.36 kg m^2."""
    kicked, plain = (Plant(SYSTEM, hold(0.5), with_pole(SYSTEM, np.pi)) for _ in range(2))
    kicked.disturb(disturbance(TroubleOptions(kick=0.1, kick_at=0.095), 2, (0, 0)))
    for _ in range(3):
        assert kicked.advance() == plain.advance() == pytest.approx(0.5)
        assert kicked.rate == plain.rate
    assert kicked.advance() == pytest.approx(0.5)  # the kick is no part of the control
    plain.advance()
    assert kicked.rate - plain.rate == pytest.approx(0.1 / 0.36, rel=1e-3)


def test_noise_is_drawn_anew_at_each_frame_and_held() -> None:
    torque = disturbance(TroubleOptions(noise=2.0), 0, (1, 2, 3))
    frames = [[torque(k, i) for i in range(STEPS_PER_FRAME)] for k in range(400)]
    assert all(len(set(steps)) == 1 for steps in frames)
    values = np.array(frames)[:, 0]
    assert values.std() == pytest.approx(2.0, rel=0.15)
    assert values[7] == disturbance(TroubleOptions(noise=2.0), 0, (1, 2, 3))(7, 4)
    assert values[7] != disturbance(TroubleOptions(noise=2.0), 0, (1, 2, 4))(7, 4)


def test_without_trouble_nothing_acts() -> None:
    torque = disturbance(TroubleOptions(), 5, (0, 0))
    assert {torque(k, i) for k in range(40) for i in range(STEPS_PER_FRAME)} == {0.0}
    assert mass_change_frame(TroubleOptions(), 5) is None
    assert mass_change_frame(TroubleOptions(change_mass_at=1.0), 5) == 25


def test_a_heavier_pole_goes_on_where_the_lighter_was() -> None:
    light = build_system("cartpole")
    heavy = build_system("cartpole", {"mass": 2.0})
    plant = Plant(light, hold(0.0), with_pole(light, 2.0))
    for _ in range(10):
        plant.advance()
    before = plant.state
    plant.look_ahead(5)
    plant.become(heavy)
    assert (plant.number, plant.system) == (10, heavy)
    assert np.array_equal(plant.state.q, before.q)
    assert plant.state.v[1] == before.v[1]
    same = Plant(heavy, hold(0.0), with_pole(heavy, plant.angle, plant.rate))
    shift = plant.state.q[0] - same.state.q[0]
    for _ in range(40):
        plant.advance()
        same.advance()
        assert plant.state.q == pytest.approx(same.state.q + np.array([shift, 0.0]), abs=1e-9)
    assert abs(plant.state.q[0]) < 0.6
