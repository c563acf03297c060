"""What moves a plant before a drive: around hanging, around the target, and to the start."""

from __future__ import annotations

import numpy as np
import pytest

from koop_clients.mechanics.simulation import FRAME_INTERVAL, Simulator, angle_between
from koop_clients.mechanics.systems import build_system
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.options import DriveOptions
from koop_clients.sim_client.schedule import approach_frame, excited


@pytest.mark.parametrize("learn", [10.0, 20.0])
@pytest.mark.parametrize(("target", "start"), [(0.0, 1.0), (0.5, -0.3)])
def test_the_plant_is_excited_around_the_target_and_then_brought_to_its_start(
    learn: float, target: float, start: float
) -> None:
    arguments = Arguments(system="cartpole", drive="mpc", driving=DriveOptions(learn=learn))
    system = build_system("cartpole")
    policy, state = excited(arguments, system, target, start, np.random.default_rng(3))
    simulator, angles = Simulator(system), []
    for number in range(int(arguments.takeover)):
        angles.append(state.q[system.pole])
        state, _ = simulator.frame(state, policy, number)
    begin, frames = int(approach_frame(arguments)), np.array(angles)
    assert (len(frames) - begin) * FRAME_INTERVAL == pytest.approx(min(10.0, 0.7 * learn))
    assert np.abs(angle_between(frames[:begin], np.pi)).max() < 2.0
    there = frames[begin + (len(frames) - begin) // 4 : -40]
    assert np.abs(there - target).max() < 2.0
    assert np.ptp(there) > 0.3
    assert state.q[system.pole] == pytest.approx(start, abs=0.2)
    assert abs(state.v[system.pole]) < 1.5


def test_without_a_drive_the_plant_stays_around_hanging() -> None:
    arguments = Arguments(system="cartpole", drive="excite")
    assert approach_frame(arguments) == np.inf
