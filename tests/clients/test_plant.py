"""Looking ahead, taking it back, and going on: the plant never notices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_clients.mechanics.excitation import excitation
from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import Simulator, hold, with_pole, without_drift
from koop_clients.mechanics.systems import build_system
from koop_clients.sim_client.plant import Plant

SYSTEM = build_system("cartpole")


def soft_plant(seed: int = 0) -> Plant:
    policy, reference = excitation(SYSTEM, "soft", np.random.default_rng(seed))
    assert reference is not None
    return Plant(SYSTEM, policy, with_pole(SYSTEM, *reference(0.0)))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 12), min_size=1, max_size=8))
def test_looking_ahead_changes_nothing(looks: list[int]) -> None:
    looking, plain = soft_plant(), soft_plant()
    for frames in looks:
        controls = looking.look_ahead(frames)
        assert controls.shape == (frames, 1)
        torques = [looking.advance(), plain.advance()]
        assert torques[0] == torques[1] == controls[0, 0]
        assert looking.number == plain.number
        assert np.array_equal(looking.state.q, plain.state.q)
        assert np.array_equal(looking.state.v, plain.state.v)
        assert np.array_equal(looking.draw(), plain.draw())


def test_what_was_looked_ahead_at_comes_true() -> None:
    plant = soft_plant()
    promised = plant.look_ahead(15)[:, 0]
    assert [plant.advance() for _ in range(15)] == promised.tolist()


def test_a_new_law_goes_on_from_the_present_frame() -> None:
    looked, plain = soft_plant(), soft_plant()
    for plant in (looked, plain):
        for _ in range(4):
            plant.advance()
    looked.look_ahead(20)
    for plant in (looked, plain):
        plant.obey(hold(-3.0))
    for number in range(4, 9):
        assert looked.number == plain.number == number
        assert looked.advance() == plain.advance() == pytest.approx(-3.0)
        assert np.array_equal(looked.state.q, plain.state.q)


def test_a_torque_may_change_every_five_milliseconds() -> None:
    plant = soft_plant()
    asked: list[tuple[int, int]] = []

    def torque(number: int, step: int, _state: object) -> float:
        asked.append((number, step))
        return 2.0 if step < 3 else -1.0

    plant.obey(torque)
    assert plant.advance() == pytest.approx(0.3 * 2.0 - 0.7 * 1.0)
    assert asked == [(0, step) for step in range(10)]


def test_the_torques_reproduce_the_states() -> None:
    plant, simulator = soft_plant(), Simulator(SYSTEM)
    state = plant.state
    for number in range(10):
        torque = plant.advance()
        state = without_drift(SYSTEM, simulator.frame(state, hold(torque), number)[0])
        assert np.allclose(state.q, plant.state.q, atol=1e-12)


def test_a_free_cartpole_is_still_in_the_picture_after_five_minutes() -> None:
    plant = Plant(SYSTEM, hold(0.0), with_pole(SYSTEM, 2.0))
    first = float(plant.draw().sum())
    while plant.number < 6000:
        plant.advance()
    assert abs(plant.state.q[0]) < 0.3
    assert float(plant.draw().sum()) == pytest.approx(first, rel=0.1)


def test_friction_keeps_the_momentum_that_is_its_own() -> None:
    system = build_system("cartpole", {"damping": 0.5})
    state = with_pole(system, 1.0)
    state.q[0] = 0.2
    assert without_drift(system, state) is state


def test_the_frame_is_the_present_state_s() -> None:
    plant = soft_plant()
    plant.advance()
    assert np.array_equal(plant.draw(), Renderer(SYSTEM)(plant.state.q))
