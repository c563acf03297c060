"""The solver against what can be calculated by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from koop_clients.flow.lattice import Lattice, equilibrium, mirrored, moments
from koop_clients.flow.walls import VELOCITIES, WEIGHTS, Wall, circle, flat

EXACT: Any = np.float64


def nowhere(shape: tuple[int, int]) -> Wall:
    return flat(np.zeros(shape, bool))


def stirred(lattice: Lattice, seed: int = 0, speed: float = 0.05) -> np.ndarray:
    """A state with random velocities and densities."""
    rng = np.random.default_rng(seed)
    shape = lattice.wall.solid.shape
    u, v = rng.uniform(-speed, speed, (2, *shape))
    state = equilibrium(rng.uniform(-0.01, 0.01, shape), u, v).astype(lattice.dtype)
    state[:, lattice.wall.solid] = 0
    return state


def test_a_closed_box_keeps_its_mass() -> None:
    solid = np.ones((14, 18), bool)
    solid[1:-1, 1:-1] = False
    lattice = Lattice(flat(solid), 0.02, dtype=EXACT)
    before = stirred(lattice)
    after = lattice.advance(before, 500)
    masses = [(~solid).sum() + moments(s)[0][~solid].sum() for s in (before, after)]
    assert masses[1] == pytest.approx(masses[0], rel=1e-13)
    assert np.abs(moments(after)[1]).max() < 0.5 * np.abs(moments(before)[1]).max()


def test_a_shear_wave_decays_with_the_viscosity() -> None:
    rows, viscosity, steps = 32, 0.03, 400
    lattice = Lattice(nowhere((rows + 2, 5)), viscosity, rim="periodic", dtype=EXACT)
    k = 2 * np.pi / rows
    u = 0.01 * np.sin(k * np.arange(rows + 2))[:, None] + np.zeros((1, 5))
    before = equilibrium(0.0, u, 0.0)
    after = lattice.advance(before, steps)
    decay = np.abs(moments(after)[1][1:-1]).max() / np.abs(moments(before)[1][1:-1]).max()
    assert decay == pytest.approx(np.exp(-viscosity * k**2 * steps), rel=2e-3)


def poiseuille_error(cells: int) -> float:
    """Largest error over the largest velocity of a channel `cells` wide under a body force."""
    force, viscosity = 1e-6, 1 / 6
    solid = np.zeros((cells + 2, 4), bool)
    solid[[0, -1]] = True
    lattice = Lattice(flat(solid), viscosity, rim="periodic", dtype=EXACT)
    pull = (3 * force * WEIGHTS * VELOCITIES[:, 0])[:, None, None] * ~solid
    state = lattice.uniform()
    for _ in range(12 * cells**2):
        state = lattice.advance(state, 1) + pull
    found = moments(state)[1][1:-1, 2] - force / 2  # half of it acts before a measurement
    y = np.arange(cells) + 0.5
    exact = force / (2 * viscosity) * y * (cells - y)
    return float(np.abs(found - exact).max() / exact.max())


def test_a_channel_s_profile_converges_with_second_order() -> None:
    coarse, fine = poiseuille_error(6), poiseuille_error(12)
    assert fine < 0.01
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


def couette_error(gap: float) -> float:
    """Largest error, over the wall's speed, of the flow in a ring around a turning cylinder."""
    inner, outer, speed, size = gap, 2 * gap, 0.02, int(4 * gap) + 6
    shape, centre = (size, size), (size / 2 - 0.8, size / 2 - 0.3)
    wall = circle(shape, centre, inner) | circle(shape, centre, outer, hollow=True, turns=False)
    lattice = Lattice(wall, 1 / 6, dtype=EXACT)
    state = lattice.advance(lattice.uniform(), int(12 * gap**2), speed / inner)
    excess, mx, my = moments(state)
    y, x = np.indices(shape, float)
    x, y = x - centre[0], y - centre[1]
    r = np.hypot(x, y)
    found = (x * my - y * mx) / (r * (1 + excess))
    b = speed * inner * outer**2 / (outer**2 - inner**2)
    exact = b / r - b * r / outer**2
    return float(np.abs(found - exact)[~wall.solid].max() / speed)


def test_a_turning_cylinder_drags_the_fluid_along() -> None:
    errors = [couette_error(gap) for gap in (5.3, 10.6, 21.2)]
    assert errors[2] < 0.01
    assert errors[2] < errors[1] / 2 < errors[0] / 4


def cylinder(dtype: Any = EXACT) -> Lattice:
    wall = circle((24, 40), (12.3, 11.5), 3.1)
    return Lattice(wall, 0.03, 0.1, dtype=dtype)


def test_the_mirror_image_flows_in_the_mirror() -> None:
    lattice = cylinder()
    state = stirred(lattice)
    assert np.array_equal(mirrored(mirrored(state)), state)
    there = lattice.advance(mirrored(state), 60, -0.02)
    assert np.allclose(there, mirrored(lattice.advance(state, 60, 0.02)), atol=1e-13)
    assert not np.allclose(there, mirrored(lattice.advance(state, 60, -0.02)), atol=1e-5)


def test_nothing_disturbs_a_free_stream() -> None:
    lattice = Lattice(nowhere((12, 20)), 0.03, 0.1, dtype=EXACT)
    state = lattice.uniform()
    assert np.allclose(lattice.advance(state, 100), state, atol=1e-15)
    assert np.allclose(moments(state)[1], 0.1)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_same_bits_come_out_each_time(dtype: Any) -> None:
    lattice = cylinder(dtype)
    state = stirred(lattice)
    kept = state.copy()
    after = lattice.advance(state, 30, 0.01)
    assert after.dtype == dtype
    assert np.array_equal(state, kept)
    assert np.array_equal(after, lattice.advance(state, 30, 0.01))
    assert np.array_equal(after, lattice.advance(lattice.advance(state, 11, 0.01), 19, 0.01))
    assert np.array_equal(after, cylinder(dtype).advance(state, 30, 0.01))
    assert not after[:, lattice.wall.solid].any()


def test_single_precision_is_close_to_double() -> None:
    exact, single = cylinder(), cylinder(np.float32)
    start = stirred(single)
    far = exact.advance(start.astype(EXACT), 200, 0.01)
    assert np.abs(single.advance(start, 200, 0.01) - far).max() < 1e-6


def test_links_are_cut_on_the_circle() -> None:
    wall = circle((24, 40), (12.3, 11.5), 3.1)
    c = VELOCITIES[wall.directions]
    x = wall.columns + wall.fractions * c[:, 0]
    y = wall.rows + wall.fractions * c[:, 1]
    assert np.allclose(np.hypot(x - 12.3, y - 11.5), 3.1)
    assert 0 <= wall.fractions.min() <= wall.fractions.max() <= 1
    assert not wall.solid[wall.rows, wall.columns].any()
    assert wall.solid[wall.rows + c[:, 1], wall.columns + c[:, 0]].all()


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="viscosity is 0; expected a number above 0"):
        Lattice(nowhere((5, 5)), 0)
    with pytest.raises(ValueError, match="take smaller time steps"):
        Lattice(nowhere((5, 5)), 0.1, 0.4)
    lattice = cylinder()
    with pytest.raises(ValueError, match=r"expected \(9, 24, 40\) float64"):
        lattice.advance(lattice.uniform().astype(np.float32), 1)
