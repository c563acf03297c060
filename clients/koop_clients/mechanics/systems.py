"""The mechanical systems of the paper (section 3.1), built as Pinocchio models.

Every system moves in the vertical x-z plane. Pole angles are about +y: 0 rad is upright, pi hangs
down. Masses sit at the poles' tips; poles are massless rods.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import coal  # pyright: ignore[reportMissingImports]
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

GRAVITY = 9.81  # m/s^2

# Grey levels in [0, 1] of the pictures.
_CART_GREY, _ROD_GREY, _BALL_GREY = 0.5, 0.75, 1.0

# Thickness of rods and balls and size of the cart, as shares of the picture's width.
_ROD, _BALL, _CART = 0.021, 0.053, (0.16, 0.065)


@dataclass(frozen=True)
class Camera:
    """An orthographic view along +y on a square, `width` metres wide, around `centre` (x, z)."""

    width: float
    centre: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class System:
    """A plant: dynamics and geometry (Pinocchio), what is actuated, and how it is looked at.

    `actuated_velocity` and `pole` index the velocity vector; torques are in N m. `parameters` are
    the physical ones (kg, m, N m s/rad) that the models were built from.
    """

    name: str
    parameters: Mapping[str, float]
    model: pin.Model
    geometry: pin.GeometryModel
    camera: Camera
    actuated_velocity: int
    pole: int


# Default value and the range that a data set with varying parameters draws from.
PARAMETERS: dict[str, dict[str, tuple[float, float, float]]] = {
    "pendulum": {"mass": (1.0, 1.0, 1.0), "length": (0.6, 0.3, 0.8), "damping": (0.0, 0.0, 0.0)},
    "double-pendulum": {
        "mass": (1.0, 0.5, 1.5),
        "mass_2": (1.0, 0.5, 1.5),
        "length": (0.45, 0.3, 0.5),
        "length_2": (0.45, 0.3, 0.5),
        "damping": (0.0, 0.0, 0.0),
    },
    "cartpole": {
        "cart_mass": (5.0, 3.0, 7.0),
        "mass": (1.0, 0.5, 1.5),
        "length": (1.0, 0.7, 1.1),
        "damping": (0.0, 0.0, 0.0),
    },
}
SYSTEMS = tuple(PARAMETERS)


def default_parameters(name: str) -> dict[str, float]:
    """The physical parameters that a system has unless told otherwise."""
    return {key: values[0] for key, values in _ranges(name).items()}


def sample_parameters(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Physical parameters drawn uniformly from the paper's ranges."""
    return {key: float(rng.uniform(low, high)) for key, (_, low, high) in _ranges(name).items()}


def build_system(name: str, parameters: Mapping[str, float] | None = None) -> System:
    """Build the plant `name`; `parameters` override the defaults.

    Raises ValueError for an unknown system, an unknown parameter or a value that is not physical.
    """
    values = default_parameters(name)
    for key, value in (parameters or {}).items():
        if key not in values:
            raise ValueError(f"{name} has no parameter {key!r}; it has {', '.join(values)}")
        if not np.isfinite(value) or value < 0 or (value == 0 and key != "damping"):
            raise ValueError(f"{key} is {value}; expected a positive, finite number")
        values[key] = float(value)
    return _BUILDERS[name](values)


def _ranges(name: str) -> dict[str, tuple[float, float, float]]:
    if name not in PARAMETERS:
        raise ValueError(f"unknown system {name!r}; koop simulates {', '.join(SYSTEMS)}")
    return PARAMETERS[name]


def _pendulum(values: dict[str, float]) -> System:
    model, geometry, camera = pin.Model(), pin.GeometryModel(), Camera(1.9)
    model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
    _add_pole(
        model, geometry, 0, pin.SE3.Identity(), values["mass"], values["length"], camera.width
    )
    return _system("pendulum", values, model, geometry, camera, 0)


def _double_pendulum(values: dict[str, float]) -> System:
    model, geometry, camera = pin.Model(), pin.GeometryModel(), Camera(2.3)
    model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
    first = _add_pole(
        model, geometry, 0, pin.SE3.Identity(), values["mass"], values["length"], camera.width
    )
    elbow = pin.SE3(np.eye(3), np.array([0.0, 0.0, values["length"]]))
    _add_pole(model, geometry, first, elbow, values["mass_2"], values["length_2"], camera.width)
    return _system("double-pendulum", values, model, geometry, camera, 0)


def _cartpole(values: dict[str, float]) -> System:
    model, geometry, camera = pin.Model(), pin.GeometryModel(), Camera(2.8)
    model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
    cart = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "cart")
    inertia = pin.Inertia(values["cart_mass"], np.zeros(3), np.zeros((3, 3)))
    model.appendBodyToJoint(cart, inertia, pin.SE3.Identity())
    wide, high = (share * camera.width for share in _CART)
    _add_shape(geometry, cart, coal.Box(wide, high, high), pin.SE3.Identity(), _CART_GREY)
    _add_pole(
        model, geometry, cart, pin.SE3.Identity(), values["mass"], values["length"], camera.width
    )
    return _system("cartpole", values, model, geometry, camera, 1)


_BUILDERS: dict[str, Callable[[dict[str, float]], System]] = {
    "pendulum": _pendulum,
    "double-pendulum": _double_pendulum,
    "cartpole": _cartpole,
}


def _system(
    name: str,
    values: dict[str, float],
    model: pin.Model,
    geometry: pin.GeometryModel,
    camera: Camera,
    pole: int,
) -> System:
    return System(name, values, model, geometry, camera, actuated_velocity=pole, pole=pole)


def _add_pole(
    model: pin.Model,
    geometry: pin.GeometryModel,
    parent: int,
    placement: pin.SE3,
    mass: float,
    length: float,
    view: float,
) -> int:
    """A revolute joint about y, a massless rod, and a ball of `mass` at its end.

    `view` [m] is the picture's width, by which thicknesses scale.
    """
    joint = model.addJoint(parent, pin.JointModelRY(), placement, f"pole_{parent}")
    tip = pin.SE3(np.eye(3), np.array([0.0, 0.0, length]))
    model.appendBodyToJoint(joint, pin.Inertia(mass, np.zeros(3), np.zeros((3, 3))), tip)
    middle = pin.SE3(np.eye(3), np.array([0.0, 0.0, length / 2]))
    _add_shape(geometry, joint, coal.Capsule(_ROD * view, length), middle, _ROD_GREY)
    _add_shape(geometry, joint, coal.Sphere(_BALL * view), tip, _BALL_GREY)
    return joint


def _add_shape(
    geometry: pin.GeometryModel, joint: int, shape: object, placement: pin.SE3, grey: float
) -> None:
    name = f"shape_{geometry.ngeoms}"
    item = pin.GeometryObject(name, joint, placement, shape)
    item.meshColor = np.array([grey, grey, grey, 1.0])
    geometry.addGeometryObject(item)
