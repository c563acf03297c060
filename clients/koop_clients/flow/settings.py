"""The flow that is simulated: its size, grid and units.

Lengths are in cylinder diameters D, speeds in U of the free stream, times in D/U, rotation in U/D.
The experiment is that of Morton, Jameson, Kochenderfer, Witherden (NeurIPS 2018), which the paper
follows: Reynolds number 50, Mach number 0.2.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

FRAME_INTERVAL = 0.15
"""What the paper calls the time between two frames [s]: a label, see `FlowSettings.frame_time`."""

WINDOW = (-2.0, 10.0, -3.0, 3.0)
"""What a frame shows: x from, to, y from, to [D]."""

PROBE = 2.14
"""Where, on the axis behind the cylinder, the transverse velocity is told [D]."""

MORTON_SPEED = 0.23664
"""The free stream's speed in the units of Morton et al., whose cylinder has diameter 1."""

MAX_ROTATION = 1.27
"""Largest rotation in use [U/D]; 0.3 in Morton's units."""

REYNOLDS = 50.0
_LARGEST_REYNOLDS = 150.0


@dataclass(frozen=True)
class FlowSettings:
    """A cylinder in a stream.

    Attributes:
        reynolds: Reynolds number U D / nu.
        diameter: of the cylinder [cells]; 64/3 makes a frame an exact crop.
        half_height: distance of the side walls from the axis [D]. Nearer ones speed the shedding
            up: Strouhal number 0.139 at 6, 0.135 at 9, 0.123 in the open.
        upstream, downstream: where the domain begins and ends [D]. They do so too: with 15.5 and
            29.5 it is 0.127 at 9.
        mach: U over the speed of sound, which is the lattice's own.
        frame_steps: time steps from one frame to the next.
    """

    reynolds: float = REYNOLDS
    diameter: float = 64 / 3
    half_height: float = 6.0
    upstream: float = 6.5
    downstream: float = 14.5
    mach: float = 0.2
    frame_steps: int = 150

    def __post_init__(self) -> None:
        if not 1 <= self.reynolds <= _LARGEST_REYNOLDS:
            raise ValueError(
                f"the Reynolds number is {self.reynolds:g}; expected 1 to {_LARGEST_REYNOLDS:g}: "
                "this grid is tried up to there, and from about 190 on a wake is no longer flat"
            )
        for name in ("diameter", "half_height", "upstream", "downstream", "mach", "frame_steps"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} is {getattr(self, name)}; expected a number above 0")
        for what, cells in self._edges().items():
            if abs(cells - round(cells)) > 1e-6:
                raise ValueError(f"{what} lies between two cells; choose another diameter")
        x0, x1, y0, y1 = WINDOW
        if -x0 >= self.upstream or x1 >= self.downstream or max(-y0, y1) >= self.half_height:
            raise ValueError("the picture reaches beyond the domain; choose a larger one")

    def _edges(self) -> dict[str, float]:
        """Distances that must be whole cells."""
        return {
            "the outlet": (self.upstream + self.downstream) * self.diameter,
            "a side wall": 2 * self.half_height * self.diameter,
            "the picture's left": (self.upstream + WINDOW[0]) * self.diameter,
            "the picture's right": (self.upstream + WINDOW[1]) * self.diameter,
            "the picture's lower edge": (self.half_height + WINDOW[2]) * self.diameter,
        }

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the lattice."""
        length = self.upstream + self.downstream
        return round(2 * self.half_height * self.diameter), round(length * self.diameter)

    @property
    def speed(self) -> float:
        """U [cells/step]."""
        return self.mach * 3**-0.5

    @property
    def viscosity(self) -> float:
        """[cells^2/step]."""
        return self.speed * self.diameter / self.reynolds

    @property
    def frame_time(self) -> float:
        """From one frame to the next [D/U]."""
        return self.frame_steps * self.speed / self.diameter

    @property
    def centre(self) -> tuple[float, float]:
        """Column and row of the cylinder's centre; cells have theirs at whole numbers."""
        return self.upstream * self.diameter - 0.5, self.half_height * self.diameter - 0.5

    @property
    def crop(self) -> tuple[slice, slice]:
        """Rows and columns of the lattice that a frame shows."""
        x0, x1, y0, y1 = WINDOW
        rows = (round((self.half_height + y) * self.diameter) for y in (y0, y1))
        columns = (round((self.upstream + x) * self.diameter) for x in (x0, x1))
        return slice(*rows), slice(*columns)

    def as_dict(self) -> dict[str, float]:
        """By name, for manifests and hashes."""
        return asdict(self)
