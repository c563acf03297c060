"""A D2Q9 lattice-Boltzmann solver with two relaxation times: a pure step from state to state.

A state is (9, ny, nx): the populations after a collision, less their weights, f_i - w_i. Without
the large constant part single precision keeps some five bits more. Its outermost cells are a rim
that is filled from outside: free stream on three sides and zero gradient at the outlet, or the
opposite side. Solid cells hold zeros between two calls.

- Two relaxation times, of which the second follows from the viscosity by the magic parameter 1/4:
  walls then stay where they are whatever the viscosity (Ginzburg, Verhaeghe, d'Humieres 2008).
- Curved walls with a velocity: Bouzidi, Firdaouss, Lallemand, Physics of Fluids 13 (2001), linear.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numba
import numpy as np

from koop_clients.flow.walls import VELOCITIES, WEIGHTS, Wall

SOUND = 3**-0.5
"""Speed of sound [cells/step]."""

_MAGIC = 1 / 4
_OPPOSITE = np.array([0, 3, 4, 1, 2, 7, 8, 5, 6])
_MIRRORED = np.array([0, 1, 4, 3, 2, 8, 7, 6, 5])  # in y
_COLUMNS, _ROWS = VELOCITIES[:, 0].copy(), VELOCITIES[:, 1].copy()

# Python's own division checks for zero, a branch that keeps the loops from being vectorised.
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


@dataclass(frozen=True, eq=False)
class Lattice:
    """What does not change while a flow evolves.

    Attributes:
        wall: solid cells and their surface; its shape (ny, nx) is the lattice's, rim included.
        viscosity: kinematic [cells^2/step].
        stream: velocity along x of the free stream, on the rim of an `open` lattice [cells/step].
        rim: `open` or `periodic` in both directions.
        dtype: float32 or float64.
    """

    wall: Wall
    viscosity: float
    stream: float = 0.0
    rim: Literal["open", "periodic"] = "open"
    dtype: Any = np.float32

    def __post_init__(self) -> None:
        if not (np.isfinite(self.viscosity) and self.viscosity > 0):
            raise ValueError(f"viscosity is {self.viscosity}; expected a number above 0")
        if not abs(self.stream) < SOUND / 2:
            raise ValueError(
                f"the stream has {self.stream} cells/step; expected less than half the speed of "
                f"sound, {SOUND / 2:.3f}: take smaller time steps"
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """(9, ny, nx) of a state."""
        return (9, *self.wall.solid.shape)

    @cached_property
    def relaxation(self) -> tuple[float, float]:
        """Rates of the even and the odd part [1/step]."""
        even = 3 * self.viscosity
        return 1 / (0.5 + even), 1 / (0.5 + _MAGIC / even)

    @cached_property
    def _numbers(self) -> np.ndarray:
        """Constants in the lattice's own precision: a Python float would widen every expression."""
        return np.array([*self.relaxation, WEIGHTS[0], WEIGHTS[1], WEIGHTS[5], 1, 0.5, 1.5, 3, 4.5],
                        self.dtype)  # fmt: skip

    @cached_property
    def _inflow(self) -> np.ndarray:
        return equilibrium(0.0, self.stream, 0.0).astype(self.dtype)

    @cached_property
    def _links(self) -> tuple[np.ndarray, ...]:
        wall = self.wall
        where = (wall.rows, wall.columns, wall.directions)
        return *where, wall.fractions.astype(self.dtype), wall.pushes.astype(self.dtype)

    @cached_property
    def _solid(self) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = np.nonzero(self.wall.solid)
        return rows, columns

    def uniform(self) -> np.ndarray:
        """The free stream everywhere; a state."""
        state = np.empty(self.shape, self.dtype)
        state[:] = self._inflow[:, None, None]
        state[:, self.wall.solid] = 0
        return state

    def advance(self, state: np.ndarray, steps: int, speed: float = 0.0) -> np.ndarray:
        """The state `steps` later, with the wall moving at `speed` times its unit velocity."""
        if state.shape != self.shape or state.dtype != self.dtype:
            raise ValueError(
                f"the state is {state.shape} {state.dtype}; expected {self.shape} "
                f"{np.dtype(self.dtype)}, as this lattice's uniform() makes it"
            )
        moving = np.dtype(self.dtype).type(speed)
        args = (self._numbers, self._inflow, self.rim == "open", self._links, moving, self._solid)
        return _run(state.copy(), np.zeros_like(state), steps, *args)


def equilibrium(
    excess: np.ndarray | float, u: np.ndarray | float, v: np.ndarray | float
) -> np.ndarray:
    """(9, ...) populations less weights, of density 1 + `excess` and velocity [cells/step]."""
    excess, u, v = np.broadcast_arrays(excess, u, v)
    cu = np.tensordot(VELOCITIES, np.stack([u, v]), 1)
    w = WEIGHTS.reshape(-1, *np.ones(u.ndim, int))
    return w * (excess + (1 + excess) * (3 * cu + 4.5 * cu**2 - 1.5 * (u**2 + v**2)))


def moments(state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Density less 1 and momentum along x and y [cells/step] of populations (9, ...)."""
    h = state
    x, y = h[5] - h[7], h[6] - h[8]
    return h.sum(axis=0), h[1] - h[3] + x - y, h[2] - h[4] + x + y


def mirrored(state: np.ndarray) -> np.ndarray:
    """The state upside down, y -> -y."""
    return np.ascontiguousarray(state[_MIRRORED, ::-1])


@_compiled
def _run(
    a: np.ndarray,
    b: np.ndarray,
    steps: int,
    numbers: np.ndarray,
    inflow: np.ndarray,
    is_open: bool,
    links: tuple[np.ndarray, ...],
    speed: float,
    solid: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """`steps` steps, to and fro between two states."""
    for _ in range(steps):
        if is_open:
            _fill_open(a, inflow)
        else:
            _fill_periodic(a)
        _reflect(a, links, speed, numbers[5])
        _stream_and_collide(a, b, numbers)
        rows, columns = solid
        for s in range(len(rows)):
            for i in range(9):
                b[i, rows[s], columns[s]] = 0
        a, b = b, a
    return a


@_compiled
def _fill_open(a: np.ndarray, inflow: np.ndarray) -> None:
    """Free stream on the left and the sides, zero gradient on the right."""
    for i in range(9):
        a[i, :, 0] = inflow[i]
        a[i, :, -1] = a[i, :, -2]
        a[i, 0, :] = inflow[i]
        a[i, -1, :] = inflow[i]


@_compiled
def _fill_periodic(a: np.ndarray) -> None:
    for i in range(9):
        a[i, :, 0] = a[i, :, -2]
        a[i, :, -1] = a[i, :, 1]
        a[i, 0, :] = a[i, -2, :]
        a[i, -1, :] = a[i, 1, :]


@_compiled
def _reflect(a: np.ndarray, links: tuple[np.ndarray, ...], speed: float, one: float) -> None:
    """Put into solid cells what comes back from the wall, where streaming fetches it.

    A link's slot, the opposite direction at its solid end, is read by its own fluid cell alone.
    """
    rows, columns, directions, fractions, pushes = links
    for k in range(len(rows)):
        y, x, i = rows[k], columns[k], directions[k]
        dy, dx, back = _ROWS[i], _COLUMNS[i], _OPPOSITE[i]
        density = one
        for j in range(9):
            density += a[j, y, x]
        there, twice = a[i, y, x], fractions[k] + fractions[k]
        push = pushes[k] * density * speed
        if twice < one:
            value = twice * there + (one - twice) * a[i, y - dy, x - dx] - push
        else:
            value = a[back, y, x] + (there - a[back, y, x] - push) / twice
        a[back, y + dy, x + dx] = value


@_compiled
def _relax(
    f: float, g: float, even: float, odd: float, rates: tuple[float, float], half: float
) -> tuple[float, float]:
    """A pair of opposite populations towards the even and odd part of their equilibrium."""
    e = rates[0] * (half * (f + g) - even)
    o = rates[1] * (half * (f - g) - odd)
    return f - e - o, g - e + o


@_compiled
def _stream_and_collide(a: np.ndarray, b: np.ndarray, numbers: np.ndarray) -> None:
    """Fetch each interior cell's populations from its neighbours in `a`; collide into `b`."""
    rates, half, one = (numbers[0], numbers[1]), numbers[6], numbers[5]
    w0, w1, w2 = numbers[2], numbers[3], numbers[4]
    k15, k3, k45 = numbers[7], numbers[8], numbers[9]
    for y in range(1, a.shape[1] - 1):
        for x in range(1, a.shape[2] - 1):
            h0 = a[0, y, x]
            h1, h3 = a[1, y, x - 1], a[3, y, x + 1]
            h2, h4 = a[2, y - 1, x], a[4, y + 1, x]
            h5, h7 = a[5, y - 1, x - 1], a[7, y + 1, x + 1]
            h6, h8 = a[6, y - 1, x + 1], a[8, y + 1, x - 1]
            excess = h0 + ((h1 + h3) + (h2 + h4)) + ((h5 + h7) + (h6 + h8))
            mx = (h1 - h3) + (h5 - h7) - (h6 - h8)
            my = (h2 - h4) + (h5 - h7) + (h6 - h8)
            inverse = one / (one + excess)
            u, v = mx * inverse, my * inverse
            rest = excess - k15 * (mx * u + my * v)
            p, q = mx + my, my - mx  # along directions 5 and 6
            b[0, y, x] = h0 - rates[0] * (h0 - w0 * rest)
            h1, h3 = _relax(h1, h3, w1 * (rest + k45 * mx * u), w1 * k3 * mx, rates, half)
            h2, h4 = _relax(h2, h4, w1 * (rest + k45 * my * v), w1 * k3 * my, rates, half)
            h5, h7 = _relax(h5, h7, w2 * (rest + k45 * p * (u + v)), w2 * k3 * p, rates, half)
            h6, h8 = _relax(h6, h8, w2 * (rest + k45 * q * (v - u)), w2 * k3 * q, rates, half)
            b[1, y, x], b[3, y, x], b[2, y, x], b[4, y, x] = h1, h3, h2, h4
            b[5, y, x], b[7, y, x], b[6, y, x], b[8, y, x] = h5, h7, h6, h8
