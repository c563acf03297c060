"""What drives a plant while its dynamics are learned: eq. 14's references under eq. 15's PD.

The paper's gains track so tightly that the torque is nearly a function of the state, and then A and
B cannot be told apart. The `soft` regime, with low gains and a random torque held for each frame,
keeps them identifiable; `soft-hanging` does so around the hanging position; `free` lets the plant
swing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from koop_clients.mechanics.simulation import FRAME_INTERVAL, STEP, Policy, State, hold
from koop_clients.mechanics.systems import System

Regime = Literal["free", "paper", "soft", "soft-hanging"]
TORQUE_BOUND = 30.0  # N m

# Largest amplitude [rad] and frequency [Hz] of each of the three sinusoids of a reference (A.2.1).
_PAPER_REFERENCE = {"pendulum": (np.pi / 3, 0.3), "cartpole": (2 * np.pi / 3, 0.1)}
_SOFT_REFERENCE = (np.pi / 3, 0.4)

# Of the soft regime: N m/rad, N m s/rad, and the random torque's standard deviation [N m].
_SOFT_GAINS = {
    "pendulum": (15.0, 2.5, 4.0),
    "double-pendulum": (15.0, 2.5, 4.0),
    "cartpole": (25.0, 5.0, 6.0),
}


@dataclass(frozen=True, eq=False)
class Reference:
    """A sum of three sinusoids (eq. 14): amplitudes [rad], angular rates [rad/s], phases [rad]."""

    amplitude: np.ndarray
    rate: np.ndarray
    phase: np.ndarray
    centre: float = 0.0

    def __call__(self, time: float) -> tuple[float, float]:
        """Angle [rad] and its rate [rad/s] at `time` [s]."""
        argument = self.rate * time + self.phase
        angle = self.centre + float(np.sum(self.amplitude * np.sin(argument)))
        return angle, float(np.sum(self.amplitude * self.rate * np.cos(argument)))


@dataclass(frozen=True, eq=False)
class Tracking:
    """PD tracking of a reference (eq. 15), optionally held for each frame and with random torque.

    A policy: call it with (frame number, step in frame, state). The random part is a function of
    the seed and the frame number, so that a rewound simulation draws the same torques again.
    """

    system: System
    reference: Reference
    proportional: float  # N m/rad
    derivative: float  # N m s/rad
    random_torque: float = 0.0  # N m, standard deviation
    hold_frame: bool = False
    seed: int = 0

    def policy(self) -> Policy:
        """The torque law; with `hold_frame` it is computed once, at each frame's first step."""
        held = [0.0]

        def torque(number: int, step: int, state: State) -> float:
            if step == 0 or not self.hold_frame:
                held[0] = self._torque(number, step, state)
            return held[0]

        return torque

    def _torque(self, number: int, step: int, state: State) -> float:
        angle, rate = self.reference(number * FRAME_INTERVAL + step * STEP)
        pole = self.system.pole
        torque = -self.proportional * (state.q[pole] - angle)
        torque -= self.derivative * (state.v[pole] - rate)
        if self.random_torque:
            draw = np.random.default_rng((self.seed, number)).normal()
            torque += self.random_torque * draw
        return float(np.clip(torque, -TORQUE_BOUND, TORQUE_BOUND))


def excitation(
    system: System, regime: Regime, rng: np.random.Generator
) -> tuple[Policy, Reference | None]:
    """The torque law of a regime, and the reference that it tracks (None when free)."""
    if regime == "free":
        return hold(0.0), None
    if regime == "paper":
        amplitude, frequency = _PAPER_REFERENCE.get(system.name, _PAPER_REFERENCE["pendulum"])
        reference = _sample_reference(rng, amplitude, frequency)
        return Tracking(system, reference, proportional=100.0, derivative=10.0).policy(), reference
    centre = np.pi if regime == "soft-hanging" else 0.0
    reference = _sample_reference(rng, *_SOFT_REFERENCE, centre)
    proportional, derivative, random_torque = _SOFT_GAINS[system.name]
    tracking = Tracking(
        system,
        reference,
        proportional,
        derivative,
        random_torque,
        hold_frame=True,
        seed=int(rng.integers(2**31)),
    )
    return tracking.policy(), reference


def _sample_reference(
    rng: np.random.Generator, amplitude: float, frequency: float, centre: float = 0.0
) -> Reference:
    return Reference(
        rng.uniform(0, amplitude, 3),
        2 * np.pi * rng.uniform(0, frequency, 3),
        rng.uniform(0, 2 * np.pi, 3),
        centre,
    )
