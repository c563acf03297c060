"""Pictures show the state that they were drawn from, today as on the day the weights were made."""

from __future__ import annotations

import hashlib

import coal  # pyright: ignore[reportMissingImports]
import numpy as np
import pytest

from koop_clients.mechanics.rendering import IMAGE_SIZE, RENDERER, Renderer, _shape
from koop_clients.mechanics.simulation import with_pole
from koop_clients.mechanics.systems import SYSTEMS, System, build_system

# Weights are trained on these very pictures: a change of any of them needs a new renderer's name,
# new data sets and new weights.
GOLDEN = {
    "pendulum": "95206d35dfd1957d",
    "double-pendulum": "496aa6c83dba785e",
    "cartpole": "4a7d53b1fad83b37",
}


def ball(image: np.ndarray, system: System) -> tuple[float, float]:
    """Where the brightest thing, the pole's tip, is: (x, z) [m]."""
    rows, columns = np.nonzero(image > 0.9 * 255)
    pixel = system.camera.width / IMAGE_SIZE
    x = (columns.mean() + 0.5) * pixel - system.camera.width / 2 + system.camera.centre[0]
    z = system.camera.width / 2 - (rows.mean() + 0.5) * pixel + system.camera.centre[1]
    return float(x), float(z)


@pytest.mark.parametrize("name", ["pendulum", "cartpole"])
@pytest.mark.parametrize("angle", np.linspace(-3.0, 3.0, 13))
def test_the_angle_can_be_read_from_the_pixels(name: str, angle: float) -> None:
    system = build_system(name)
    state = with_pole(system, angle)
    x, z = ball(Renderer(system)(state.q), system)
    pivot = state.q[0] if name == "cartpole" else 0.0
    assert np.arctan2(x - pivot, z) == pytest.approx(angle, abs=0.03)
    assert np.hypot(x - pivot, z) == pytest.approx(system.parameters["length"], abs=0.02)


def test_upright_is_hanging_upside_down() -> None:
    system = build_system("pendulum")
    upright, hanging = (Renderer(system)(with_pole(system, a).q) for a in (0.0, np.pi))
    assert upright[:32].sum() > 5 * upright[36:].sum()
    assert np.abs(upright[::-1].astype(int) - hanging).max() <= 1


def test_left_is_right_in_a_mirror() -> None:
    system = build_system("cartpole")
    left, right = (Renderer(system)(with_pole(system, a).q) for a in (-1.0, 1.0))
    assert np.abs(left[:, ::-1].astype(int) - right).max() <= 1


def test_nothing_leaves_the_picture() -> None:
    for name in SYSTEMS:
        system = build_system(name)
        states = np.stack([with_pole(system, a).q for a in np.linspace(0, 6.2, 40)])
        images = Renderer(system).sequence(states)
        assert images[:, [0, -1]].max() == 0
        assert images[:, :, [0, -1]].max() == 0


def test_a_sequence_is_its_frames() -> None:
    system = build_system("double-pendulum")
    states = np.stack([with_pole(system, a).q for a in (0.3, 2.0)])
    renderer = Renderer(system)
    assert np.array_equal(renderer.sequence(states), np.stack([renderer(q) for q in states]))


def test_an_unknown_shape_is_refused() -> None:
    class Item:
        geometry = coal.Cone(0.1, 0.2)

    with pytest.raises(ValueError, match="cannot draw a Cone; use capsules, spheres and boxes"):
        _shape(Item())


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_renderer_draws_what_the_weights_were_trained_on(name: str) -> None:
    system = build_system(name)
    states = np.stack([with_pole(system, a).q for a in np.linspace(0, 6, 25)])
    digest = hashlib.sha256(Renderer(system).sequence(states).tobytes()).hexdigest()[:16]
    assert (RENDERER, digest) == ("koop-sdf-1", GOLDEN[name])
