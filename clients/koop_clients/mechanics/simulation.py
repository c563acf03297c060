"""Time stepping: 5 ms semi-implicit Euler steps of the forward dynamics, a frame every 50 ms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from koop_clients.mechanics.systems import GRAVITY, System

STEP = 0.005  # s, also the period at which torques may change
FRAME_INTERVAL = 0.05  # s
STEPS_PER_FRAME = round(FRAME_INTERVAL / STEP)

# The torque [N m] on the actuated joint as a function of (frame number, step in frame, state).
Policy = Callable[[int, int, "State"], float]

# A torque [N m] on the same joint that nobody decides, of (frame number, step in frame).
Disturbance = Callable[[int, int], float]


@dataclass(frozen=True, eq=False)
class State:
    """Configuration `q` (m, rad) and velocity `v` (m/s, rad/s), both (nv,)."""

    q: np.ndarray
    v: np.ndarray


class Simulator:
    """Advances states of one system. Holds only Pinocchio's scratch memory: no state of its own."""

    def __init__(self, system: System) -> None:
        self.system = system
        self._data = system.model.createData()
        self._torque = np.zeros(system.model.nv)

    def step(self, state: State, torque: float) -> State:
        """One step of `STEP` seconds under a torque [N m] on the actuated joint."""
        model, damping = self.system.model, self.system.parameters["damping"]
        self._torque[:] = -damping * state.v
        self._torque[self.system.actuated_velocity] += torque
        acceleration = pin.aba(model, self._data, state.q, state.v, self._torque)
        v = state.v + STEP * acceleration
        return State(pin.integrate(model, state.q, STEP * v), v)

    def frame(
        self, state: State, policy: Policy, number: int, disturbance: Disturbance | None = None
    ) -> tuple[State, float]:
        """From frame `number` to the next: the new state and the mean of the policy's torque."""
        total = 0.0
        for i in range(STEPS_PER_FRAME):
            torque = policy(number, i, state)
            total += torque
            state = self.step(state, torque + (disturbance(number, i) if disturbance else 0.0))
        return state, total / STEPS_PER_FRAME


def hold(torque: float) -> Policy:
    """The same torque [N m] during the whole frame."""
    return lambda _number, _step, _state: torque


def with_pole(system: System, angle: float, rate: float = 0.0) -> State:
    """The first pole at `angle` [rad] (0 upright, pi hanging) and `rate` [rad/s].

    The cart of a cartpole is free: it gets no horizontal momentum and the centre of mass stands in
    the middle of the picture, since any other start drifts out of it.
    """
    q, v = np.zeros(system.model.nq), np.zeros(system.model.nv)
    q[system.pole], v[system.pole] = angle, rate
    return _centred(system, State(q, v))


def without_drift(system: System, state: State) -> State:
    """`state` with what the time stepping adds to a free cartpole's momentum taken away again.

    A free swing of a minute would drift by some 20 cm, and leave the picture in five. With friction
    on the rail the momentum is the plant's own, and stays.
    """
    return state if system.parameters["damping"] else _centred(system, state)


def _centred(system: System, state: State) -> State:
    """The cart where, and as fast as, the centre of mass rests in the middle."""
    if system.name != "cartpole":
        return state
    values, pole = system.parameters, system.pole
    arm = values["mass"] * values["length"] / (values["mass"] + values["cart_mass"])
    q, v = state.q.copy(), state.v.copy()
    q[0], v[0] = -arm * np.sin(q[pole]), -arm * np.cos(q[pole]) * v[pole]
    return State(q, v)


def angle_between(angle: np.ndarray | float, target: np.ndarray | float) -> np.ndarray:
    """Signed difference in [-pi, pi) [rad]."""
    return (np.asarray(angle) - target + np.pi) % (2 * np.pi) - np.pi


def random_state(system: System, rng: np.random.Generator, high: bool = False) -> State:
    """A random initial state: the first pole in [pi/2, 3 pi/2] for good, or anywhere if `high`.

    The low-amplitude rate keeps the energy under that of a resting horizontal pole (A.2.2).
    """
    if high:
        return with_pole(system, rng.uniform(0, 2 * np.pi), rng.uniform(-1, 1))
    angle = rng.uniform(np.pi / 2, 3 * np.pi / 2)
    fastest = np.sqrt(-2 * GRAVITY * np.cos(angle) / system.parameters["length"])
    return with_pole(system, angle, rng.uniform(-1, 1) * fastest)
