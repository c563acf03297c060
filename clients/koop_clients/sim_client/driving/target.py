"""Where a drive goes: a picture for the service, and the angle that it shows for the judge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from koop_clients.mechanics.rendering import IMAGE_SIZE, Renderer
from koop_clients.mechanics.simulation import angle_between, with_pole
from koop_clients.mechanics.systems import System
from koop_clients.sim_client.options import DriveOptions
from koop_clients.sim_client.scoring import rmse

_COARSE, _FINE = 360, 41  # angles tried: all around, then within a step of the best of those


@dataclass(frozen=True, eq=False)
class Target:
    """A pole's place.

    Attributes:
        picture: (64, 64) uint8.
        angle: of the pole there [rad]; for a picture from a file, the one that looks most like it.
        mismatch: RMSE of the picture and of the plant at that angle, in units of full white.
    """

    picture: np.ndarray
    angle: float
    mismatch: float = 0.0


def read_target(options: DriveOptions, system: System) -> Target:
    """The target that the options tell, of this plant.

    Raises:
        ValueError: there is no such picture, or it is not a grey one of 64 x 64 pixels.
    """
    if not options.is_picture:
        return Target(Renderer(system)(with_pole(system, options.angle).q), options.angle)
    picture = read_picture(Path(options.target))
    return Target(picture, *_most_alike(system, picture))


def read_picture(path: Path) -> np.ndarray:
    """A grey picture (64, 64) uint8 from a .png or a .npy file; raises ValueError."""
    if not path.is_file():
        raise ValueError(f"--target is {path}, and there is no such file")
    try:
        array = np.load(path, allow_pickle=False) if path.suffix == ".npy" else _read_png(path)
    except (OSError, ValueError, SyntaxError) as error:
        raise ValueError(f"--target is {path}, which cannot be read: {error}") from error
    shape = (IMAGE_SIZE, IMAGE_SIZE)
    if array.shape != shape or array.dtype != np.uint8:
        raise ValueError(
            f"--target is {path}, which holds {array.shape} {array.dtype}; expected a grey picture "
            f"of {shape} in uint8, like the plant's own"
        )
    return array


def _read_png(path: Path) -> np.ndarray:
    """(H, W) uint8; (H, W, channels) where it is no grey picture."""
    import matplotlib.image  # takes its time to load

    values = np.rint(255 * matplotlib.image.imread(path)).astype(np.uint8)
    if values.ndim == 3:
        colours = values[..., :3]
        if (colours == colours[..., :1]).all():
            return colours[..., 0]
    return values


def _most_alike(system: System, picture: np.ndarray) -> tuple[float, float]:
    """Angle [rad] of the resting pole that looks most like the picture, and the RMSE there."""
    angle, step = 0.0, math.pi
    for count in (_COARSE, _FINE, _FINE):
        tried = angle + np.linspace(-step, step, count)
        errors = _mismatch(system, tried, picture)
        best = int(np.argmin(errors))
        angle, step = float(tried[best]), 2 * step / (count - 1)
    angle = float(angle_between(angle, 0.0))
    return angle, float(_mismatch(system, np.array([angle]), picture)[0])


def _mismatch(system: System, angles: np.ndarray, picture: np.ndarray) -> np.ndarray:
    places = np.stack([with_pole(system, float(angle)).q for angle in angles])
    return rmse(Renderer(system).sequence(places), picture[None])
