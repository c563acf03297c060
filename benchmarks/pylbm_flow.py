"""The flow past the cylinder in pylbm, for the benchmarks: the same lattice, scheme and walls.

pylbm 0.11 (BSD-3) generates C code and compiles it at each start, in double precision. It is not a
dependency of koop. Where there is no MPI library: `pip install pylbm mpich`.
"""

from __future__ import annotations

import contextlib
import tempfile
from typing import Any

import numpy as np

from koop_clients.flow.cylinder import CylinderFlow
from koop_clients.flow.settings import FlowSettings
from koop_clients.flow.walls import VELOCITIES


def load() -> Any:
    """The module, or why it does not load (str)."""
    try:
        import pylbm
    except (ImportError, RuntimeError) as error:  # RuntimeError: mpi4py finds no MPI library
        reason = str(error).splitlines()[0]
        return f"pylbm does not load here ({reason}): pip install pylbm mpich"
    return pylbm


def compiled(pylbm: Any, description: dict[str, Any]) -> Any:
    """The simulation. It is built in the current folder, and setuptools stumbles over a
    repository there."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        return pylbm.Simulation(description)


def stock(pylbm: Any, settings: FlowSettings) -> dict[str, Any]:
    """The flow with pylbm's own boundaries, at rest, on as many cells as ours."""
    return _flow(pylbm, settings, pylbm.bc.BouzidiBounceBack, pylbm.bc.BouzidiBounceBack, 0)


class SamePeer:
    """The flow with our boundaries, which pylbm lacks: a peer of the bulk and the curved wall.

    - Free stream: the equilibrium in the outermost cells; pylbm would bounce back on a moving wall.
    - Where the cylinder turns, the wall's push is divided by 2q for q >= 1/2 as Bouzidi has it, and
      takes the density beside the wall; in pylbm it is neither divided, nor knows a density.

    pylbm finds the wall's links and their lengths q itself, and streams and collides in moments.
    """

    def __init__(self, pylbm: Any, settings: FlowSettings) -> None:
        self._settings = settings
        rim, self._wall = _boundaries(pylbm)
        self._simulation = compiled(pylbm, _flow(pylbm, settings, rim, self._wall, 1))

    def advance(self, steps: int, rotation: float = 0.0) -> None:
        """Go on, with the cylinder turning at `rotation` [U/D]."""
        self._wall.speed = rotation * self._settings.speed / self._settings.diameter
        for _ in range(steps):
            self._simulation.one_time_step()

    def fields(self) -> np.ndarray:
        """Density, and velocity along x and y [cells/step], (3, ny - 2, nx - 2): less the rim."""
        rho, qx, qy = (np.array(self._simulation.m[name]).T for name in _symbols()[2:])
        return np.stack([rho, qx / rho, qy / rho])


def _symbols() -> tuple[Any, ...]:
    import sympy

    return sympy.symbols("X,Y,rho,qx,qy")


def _flow(
    pylbm: Any, settings: FlowSettings, rim: Any, wall: Any, rim_cells: int
) -> dict[str, Any]:
    """Lengths in D. Our outermost cells are a rim; pylbm's lie outside its box."""
    _, _, rho, qx, qy = _symbols()
    s, u, cell = settings, settings.speed, 1 / settings.diameter
    cut = rim_cells * cell

    def inflow(_f: Any, m: Any, _x: Any, _y: Any) -> None:
        m[rho], m[qx], m[qy] = 1.0, u, 0.0

    def turning(_f: Any, m: Any, x: Any, y: Any) -> None:
        m[rho], m[qx], m[qy] = 1.0, -y / cell, x / cell  # 1 rad/step; the push is linear in it

    return {
        "box": {
            "x": [cut - s.upstream, s.downstream - cut],
            "y": [cut - s.half_height, s.half_height - cut],
            "label": [0, 1, 0, 0],
        },
        "elements": [pylbm.Circle([0, 0], 0.5, label=2)],
        "space_step": cell,
        "scheme_velocity": 1,
        "schemes": [_scheme(settings)],
        "init": {rho: 1.0, qx: u, qy: 0.0},
        "boundary_conditions": {
            0: {"method": {0: rim}, "value": inflow},
            1: {"method": {0: pylbm.bc.NeumannX}},
            2: {"method": {0: wall}, **({"value": turning} if rim_cells else {})},
        },
        "generator": "cython",
    }


def _scheme(settings: FlowSettings) -> dict[str, Any]:
    """d'Humieres' moments, relaxed with our two rates towards our equilibrium."""
    x, y, rho, qx, qy = _symbols()
    even, odd = CylinderFlow(settings).lattice.relaxation
    r2, q2 = x**2 + y**2, (qx**2 + qy**2) / rho
    return {
        # pylbm numbers D2Q9's velocities as we do.
        "velocities": list(range(len(VELOCITIES))),
        "polynomials": [1, x, y, 3 * r2 - 4, (9 * r2**2 - 21 * r2 + 8) / 2, 3 * x * r2 - 5 * x,
                        3 * y * r2 - 5 * y, x**2 - y**2, x * y],
        "conserved_moments": [rho, qx, qy],
        "relaxation_parameters": [0, 0, 0, even, even, odd, odd, even, even],
        "equilibrium": [rho, qx, qy, 3 * q2 - 2 * rho, rho - 3 * q2, -qx, -qy,
                        (qx**2 - qy**2) / rho, qx * qy / rho],
    }  # fmt: skip


def _boundaries(pylbm: Any) -> tuple[Any, Any]:
    """Our rim and our wall, as pylbm's kind of class."""
    from pylbm.generator import For
    from pylbm.symbolic import indexed, ix, nx, ny, nz
    from sympy import Eq, Idx

    class Rim(pylbm.boundary.BoundaryMethod):
        """The equilibrium in the cells outside."""

        def set_iload(self) -> None:
            """Nothing is read."""

        def set_rhs(self) -> None:
            k = self.istore[:, 0]
            self.rhs[:] = self.feq[k, np.arange(k.size)]

        def generate(self, sorder: Any) -> None:
            istore, _, count = self._get_istore_iload_symb(2)
            rhs, _ = self._get_rhs_dist_symb(count)
            i = Idx(ix, (0, count))
            where = [istore[i, axis] for axis in range(3)]
            stored = indexed("f", [9, nx, ny, nz], index=where, priority=sorder)
            self.generator.add_routine(("koop_rim", For(i, Eq(stored, rhs[i]))))

        @property
        def function(self) -> Any:
            return self.generator.module.koop_rim

    class Wall(pylbm.bc.BouzidiBounceBack):
        """Bouzidi, Firdaouss, Lallemand with a wall that moves."""

        speed = 0.0  # rad/step

        def update(self, ff: Any, **options: Any) -> None:
            near = self.iload[0]
            density = ff.swaparray[:, near[:, 1], near[:, 2]].sum(axis=0)
            share = np.where(self.distance < 0.5, 1.0, 0.5 / self.distance)
            self.rhs *= share * density * Wall.speed
            super().update(ff, **options)

    return Rim, Wall
