"""Walls inside a lattice: which cells are solid, and where each link from fluid to solid is cut.

Indices are (row, column) = (y, x), cells are squares of side 1 with their centres at integers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

VELOCITIES = np.array(
    [(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)]
)
"""(9, 2) of D2Q9, as (x, y) [cells/step]."""

WEIGHTS = np.array([4 / 9] + 4 * [1 / 9] + 4 * [1 / 36])
"""(9,) of D2Q9."""

# Distances and wall velocities of L links, of their rows and columns (L,) and direction (2,).
_Distance = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
_Velocity = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Wall:
    """Solid cells and the links that cross their surface, each from the fluid into the solid.

    Attributes:
        solid: (ny, nx) bool.
        rows, columns: (L,) of the links' fluid cells.
        directions: (L,) index into VELOCITIES.
        fractions: (L,) share of the link that lies in the fluid, in [0, 1].
        pushes: (L,) 6 w_i c_i . u at the crossing, u [cells/step] being the wall's velocity there
            when it moves with speed 1.
    """

    solid: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    directions: np.ndarray
    fractions: np.ndarray
    pushes: np.ndarray

    def __or__(self, other: Wall) -> Wall:
        """Both walls; they may touch nowhere."""
        names = ("rows", "columns", "directions", "fractions", "pushes")
        parts = (np.concatenate([getattr(self, name), getattr(other, name)]) for name in names)
        return Wall(self.solid | other.solid, *parts)


def circle(
    shape: tuple[int, int],
    centre: tuple[float, float],
    radius: float,
    *,
    hollow: bool = False,
    turns: bool = True,
) -> Wall:
    """A disc in the fluid, or, if `hollow`, the fluid in a round hole.

    `centre` is (x, y), `radius` in cells. Where it `turns`, speed 1 is one rad/step about the
    centre, counter-clockwise with y upwards.
    """
    rows, columns = np.indices(shape, float)
    inside = np.hypot(columns - centre[0], rows - centre[1]) < radius
    side = 1.0 if hollow else -1.0

    def distance(rows: np.ndarray, columns: np.ndarray, c: np.ndarray) -> np.ndarray:
        # |p + t c| = radius; the near crossing from outside, the far one from inside.
        p = np.stack([columns - centre[0], rows - centre[1]])
        along, square = c @ p, c @ c
        root = np.sqrt(along**2 - square * (np.sum(p**2, axis=0) - radius**2))
        return (side * root - along) / square

    def velocity(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return float(turns) * np.stack([centre[1] - y, x - centre[0]])

    return _wall(~inside if hollow else inside, distance, velocity)


def flat(solid: np.ndarray, velocity: tuple[float, float] = (0.0, 0.0)) -> Wall:
    """Straight walls half-way between cells; `velocity` is (x, y), of all solid cells alike."""

    def distance(rows: np.ndarray, _columns: np.ndarray, _c: np.ndarray) -> np.ndarray:
        return np.full(len(rows), 0.5)

    def everywhere(x: np.ndarray, _y: np.ndarray) -> np.ndarray:
        return np.outer(velocity, np.ones_like(x))

    return _wall(solid, distance, everywhere)


def _wall(solid: np.ndarray, distance: _Distance, velocity: _Velocity) -> Wall:
    fluid = ~solid
    fluid[[0, -1]] = fluid[:, [0, -1]] = False  # the rim is filled from outside
    parts = []
    for i in range(1, 9):
        c = VELOCITIES[i]
        rows, columns = np.nonzero(fluid & np.roll(solid, (-c[1], -c[0]), (0, 1)))
        q = distance(rows, columns, c)
        push = 6 * WEIGHTS[i] * (c @ velocity(columns + q * c[0], rows + q * c[1]))
        parts.append((rows, columns, np.full(len(rows), i), q, push))
    return Wall(solid, *(np.concatenate(column) for column in zip(*parts, strict=True)))
