"""The plant near a resting pole, as a discrete linear system under torques held for a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from koop_clients.mechanics.simulation import (
    Simulator,
    State,
    angle_between,
    hold,
    with_pole,
    without_drift,
)
from koop_clients.mechanics.systems import System

_STEP = 1e-5  # rad, rad/s, N m: of the central differences
_ACCURACY, _ITERATIONS, _LARGEST = 1e-12, 100_000, 1e100


@dataclass(frozen=True, eq=False)
class LinearPlant:
    """x' = A x + B (u - torque), from one frame to the next.

    x (2m,) holds the poles' angles from their rest [rad] and their rates [rad/s]; a cart follows
    from them, since it has no momentum of its own.

    Attributes:
        system: the plant.
        rest: (m,) the poles' angles at rest [rad].
        torque: what holds the plant there [N m].
        A: (2m, 2m).
        B: (2m,).
    """

    system: System
    rest: np.ndarray
    torque: float
    A: np.ndarray
    B: np.ndarray

    def error(self, state: State) -> np.ndarray:
        """x (2m,) of a state."""
        poles = _poles(self.system)
        return np.concatenate([angle_between(state.q[poles], self.rest), state.v[poles]])


def linearise(system: System, angle: float) -> LinearPlant:
    """The plant around its (first) pole resting at `angle` [rad], by central differences."""
    rest = with_pole(system, angle).q
    torque = _holding_torque(system, rest)
    simulator, poles = Simulator(system), _poles(system)
    size = 2 * len(poles)

    def follow(x: np.ndarray, u: float) -> np.ndarray:
        state, _ = simulator.frame(_state(system, rest, x), hold(torque + u), 0)
        state = without_drift(system, state)
        return np.concatenate([state.q[poles] - rest[poles], state.v[poles]])

    moved = _STEP * np.eye(size)
    A = np.stack([follow(d, 0.0) - follow(-d, 0.0) for d in moved], axis=1) / (2 * _STEP)
    still = np.zeros(size)
    B = (follow(still, _STEP) - follow(still, -_STEP)) / (2 * _STEP)
    return LinearPlant(system, rest[poles], torque, A, B)


def stationary_gain(plant: LinearPlant, Q: np.ndarray, r: float) -> np.ndarray:
    """K (2m,) of the best control u = torque - K x for sum x^T Q x + r (u - torque)^2."""
    A, B = plant.A, plant.B
    P = Q
    for _ in range(_ITERATIONS):
        gain = B @ P @ A / (r + B @ P @ B)
        after = Q + A.T @ P @ (A - np.outer(B, gain))
        largest, change = np.abs(after).max(), np.abs(after - P).max()
        if change <= _ACCURACY * largest:
            return gain
        if largest > _LARGEST:
            break
        P = 0.5 * (after + after.T)
    raise ValueError(f"no torque of the motor holds the {plant.system.name} at this target")


def _poles(system: System) -> np.ndarray:
    return np.arange(system.pole, system.model.nv)


def _holding_torque(system: System, rest: np.ndarray) -> float:
    still = np.zeros(system.model.nv)
    torques = pin.rnea(system.model, system.model.createData(), rest, still, still)
    return float(torques[system.actuated_velocity])


def _state(system: System, rest: np.ndarray, x: np.ndarray) -> State:
    poles = _poles(system)
    q, v = rest.copy(), np.zeros(system.model.nv)
    q[poles] += x[: len(poles)]
    v[poles] = x[len(poles) :]
    return without_drift(system, State(q, v))
