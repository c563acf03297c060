"""Flow past a cylinder that may turn: from frame to frame, and what a frame shows.

A frame has four channels in Morton's units (rho = p = 1 and U = 0.23664 far away, gamma = 1.4):
density rho, momenta rho u and rho v, energy E. The lattice is isothermal, so that E is a function
of the other three: E = rho^1.4 / 0.4 + ((rho u)^2 + (rho v)^2) / (2 rho). The cylinder's own pixels
carry the free stream. Row 0 is on top.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from koop_clients.flow.lattice import Lattice, mirrored, moments
from koop_clients.flow.settings import MAX_ROTATION, PROBE, FlowSettings
from koop_clients.flow.walls import circle

RENDERER = "koop-lbm-1"
"""Name of what makes these pictures, normalisation included."""

CHANNELS = ("rho", "rho u", "rho v", "E")

# Mean and standard deviation of each channel over the pixels of the natural wake at Re 50, rounded.
# They are part of the renderer: every Reynolds number and every forcing is shown with the same.
# Half precision then errs by 2e-4 (RMS), and so do predictions, which err by 0.02 anyway; from
# frame to frame the channels change by 0.17 to 0.55.
MEAN = np.array([0.998, 0.218, 0.0, 2.519], np.float32)
SCALE = np.array([0.0043, 0.0685, 0.0316, 0.0191], np.float32)

GAMMA = 1.4
FREE_STREAM = 0.2 * GAMMA**0.5  # U at Mach 0.2


class DivergedError(ArithmeticError):
    """The solver has left the numbers that it can represent."""

    def __init__(self, settings: FlowSettings) -> None:
        super().__init__(settings)
        self.settings = settings

    def __str__(self) -> str:
        return (
            f"the flow diverged at Reynolds number {self.settings.reynolds:g} on "
            f"{self.settings.diameter:g} cells a diameter; take a lower one or a finer grid"
        )


class Turn(NamedTuple):
    """So many lattice `steps` under one `rotation` [U/D]."""

    steps: int
    rotation: float


class CylinderFlow:
    """Advances states of one flow. Holds the lattice, which never changes: no state of its own."""

    def __init__(self, settings: FlowSettings | None = None, dtype: Any = np.float32) -> None:
        self.settings = settings = settings or FlowSettings()
        wall = circle(settings.shape, settings.centre, settings.diameter / 2)
        self.lattice = Lattice(wall, settings.viscosity, settings.speed, dtype=dtype)
        self._inside = wall.solid[settings.crop][::-1]

    def at_rest(self) -> np.ndarray:
        """The free stream everywhere, as if the cylinder had come out of nothing; a state."""
        return self.lattice.uniform()

    def frame(self, state: np.ndarray, rotation: float = 0.0) -> np.ndarray:
        """The state one frame later; the cylinder turns with `rotation` [U/D] meanwhile.

        Raises DivergedError.
        """
        return self.turned(state, [Turn(self.settings.frame_steps, rotation)])

    def turned(self, state: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
        """The state after all of these. Raises DivergedError."""
        settings = self.settings
        for steps, rotation in turns:
            if not abs(rotation) <= MAX_ROTATION * (1 + 1e-9):
                raise ValueError(
                    f"the rotation is {rotation:g} U/D; expected {-MAX_ROTATION} to {MAX_ROTATION}"
                )
            speed = rotation * settings.speed / settings.diameter
            state = self.lattice.advance(state, steps, speed)
        if not np.isfinite(state[0].sum()):
            raise DivergedError(settings)
        return state

    def mirrored(self, state: np.ndarray) -> np.ndarray:
        """The state upside down."""
        return mirrored(state)

    def channels(self, state: np.ndarray) -> np.ndarray:
        """What a frame shows in Morton's units, (4, H, W) float32: (4, 128, 256) by default."""
        excess, mx, my = moments(state[:, *self.settings.crop][:, ::-1])
        rho, unit = 1 + excess, FREE_STREAM / self.settings.speed
        mx, my = mx * unit, my * unit
        rho[self._inside], mx[self._inside], my[self._inside] = 1, FREE_STREAM, 0
        energy = rho**GAMMA / (GAMMA - 1) + (mx**2 + my**2) / (2 * rho)
        return np.stack([rho, mx, my, energy]).astype(np.float32)

    def picture(self, state: np.ndarray) -> np.ndarray:
        """A frame as it is stored and streamed, (4, H, W) float16: (channel - MEAN) / SCALE."""
        return normalised(self.channels(state)).astype(np.float16)

    def probe(self, state: np.ndarray) -> float:
        """Transverse velocity at (`PROBE`, 0) behind the cylinder [U]."""
        settings = self.settings
        x, y = settings.centre[0] + PROBE * settings.diameter, settings.centre[1]
        column, row = int(x), int(y)
        excess, _, my = moments(state[:, row : row + 2, column : column + 2])
        v = my / (1 + excess) / settings.speed
        return float(_weights(y - row) @ v @ _weights(x - column))


def normalised(channels: np.ndarray) -> np.ndarray:
    """(..., 4, H, W) in Morton's units to what a picture holds."""
    return (channels - MEAN[:, None, None]) / SCALE[:, None, None]


def in_units(pictures: np.ndarray) -> np.ndarray:
    """(..., 4, H, W) of pictures back to Morton's units, float32."""
    return pictures.astype(np.float32) * SCALE[:, None, None] + MEAN[:, None, None]


def stream_momentum(momenta: np.ndarray) -> np.ndarray:
    """x-momentum over the free stream's, float32, of that channel of pictures (..., H, W)."""
    return (momenta.astype(np.float32) * SCALE[1] + MEAN[1]) / np.float32(FREE_STREAM)


def _weights(share: float) -> np.ndarray:
    return np.array([1 - share, share])
