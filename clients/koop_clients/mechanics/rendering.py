"""Pictures of a plant: signed-distance drawing of its Pinocchio geometry.

Draws the very geometry that the dynamics carry, orthographically and anti-aliased, at some ten
thousand frames a second on one core. Training data and live streams use this one renderer; its
name travels with both, because weights trained on one renderer do not fit another.
"""

from __future__ import annotations

import coal  # pyright: ignore[reportMissingImports]
import numba
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from koop_clients.mechanics.systems import System

RENDERER = "koop-sdf-1"
IMAGE_SIZE = 64  # pixels

_CAPSULE, _BOX = 0, 1


class Renderer:
    """Draws states of one system as (size, size) uint8 pictures, row 0 on top."""

    def __init__(self, system: System, size: int = IMAGE_SIZE) -> None:
        self._system = system
        self._size = size
        self._data = system.model.createData()
        self._geometry_data = system.geometry.createData()
        self._shapes = [_shape(item) for item in system.geometry.geometryObjects]
        self._greys = np.array([item.meshColor[0] for item in system.geometry.geometryObjects])

    def __call__(self, configuration: np.ndarray) -> np.ndarray:
        """Draw one configuration (nq,)."""
        return self.sequence(configuration[None])[0]

    def sequence(self, configurations: np.ndarray) -> np.ndarray:
        """Draw configurations (T, nq) as (T, size, size) uint8."""
        figures = np.stack([self._place(q) for q in configurations])
        camera = self._system.camera
        return _draw(figures, self._greys, self._size, camera.width, *camera.centre)

    def _place(self, configuration: np.ndarray) -> np.ndarray:
        """Each shape as (kind, x, z, axis_x, axis_z, half length, half thickness) in metres."""
        system = self._system
        pin.updateGeometryPlacements(
            system.model, self._data, system.geometry, self._geometry_data, configuration
        )
        rows = np.empty((len(self._shapes), 7))
        for row, placement, (kind, length, thickness) in zip(
            rows, self._geometry_data.oMg, self._shapes, strict=True
        ):
            centre, axis = placement.translation, placement.rotation[:, 2]
            row[:] = kind, centre[0], centre[2], axis[0], axis[2], length, thickness
        return rows


def _shape(item: pin.GeometryObject) -> tuple[int, float, float]:
    """(kind, half length along the local z axis, half thickness) of a capsule, sphere or box."""
    shape = item.geometry
    if isinstance(shape, coal.Capsule):
        return _CAPSULE, shape.halfLength, shape.radius
    if isinstance(shape, coal.Sphere):
        return _CAPSULE, 0.0, shape.radius
    if isinstance(shape, coal.Box):
        return _BOX, shape.halfSide[2], shape.halfSide[0]
    raise ValueError(f"cannot draw a {type(shape).__name__}; use capsules, spheres and boxes")


@numba.njit(cache=True, nogil=True)
def _distance(figure: np.ndarray, x: float, z: float) -> float:
    """Signed distance in metres from the point (x, z) to the figure's outline."""
    dx, dz = x - figure[1], z - figure[2]
    along = dx * figure[3] + dz * figure[4]
    across = dx * figure[4] - dz * figure[3]
    if figure[0] == _CAPSULE:
        beyond = abs(along) - figure[5]
        beyond = max(beyond, 0.0)
        return np.sqrt(beyond * beyond + across * across) - figure[6]
    ex, ez = abs(along) - figure[5], abs(across) - figure[6]
    outside = np.sqrt(max(ex, 0.0) ** 2 + max(ez, 0.0) ** 2)
    return outside + min(max(ex, ez), 0.0)


@numba.njit(cache=True, nogil=True)
def _draw(
    figures: np.ndarray, greys: np.ndarray, size: int, width: float, cx: float, cz: float
) -> np.ndarray:
    """Later figures cover earlier ones; coverage falls off linearly over one pixel."""
    frames, shapes = figures.shape[0], figures.shape[1]
    images = np.zeros((frames, size, size), np.uint8)
    pixel = width / size
    canvas = np.empty((size, size))
    for t in range(frames):
        canvas[:] = 0.0
        for s in range(shapes):
            figure = figures[t, s]
            reach = figure[5] + figure[6] + pixel
            first = max(0, int((cz + width / 2 - figure[2] - reach) / pixel))
            last = min(size, int((cz + width / 2 - figure[2] + reach) / pixel) + 1)
            left = max(0, int((figure[1] - reach - cx + width / 2) / pixel))
            right = min(size, int((figure[1] + reach - cx + width / 2) / pixel) + 1)
            for i in range(first, last):
                z = cz + width / 2 - (i + 0.5) * pixel
                for j in range(left, right):
                    x = cx - width / 2 + (j + 0.5) * pixel
                    cover = 0.5 - _distance(figure, x, z) / pixel
                    cover = min(max(cover, 0.0), 1.0)
                    canvas[i, j] += cover * (greys[s] - canvas[i, j])
        for i in range(size):
            for j in range(size):
                images[t, i, j] = np.uint8(canvas[i, j] * 255.0 + 0.5)
    return images
