"""What drives a plant while its dynamics are learned: eq. 14's references under eq. 15's PD.

The paper's gains track so tightly that the torque is nearly a function of the state, and then A and
B cannot be told apart. The `probing` regime tracks livelier references and adds a multisine torque,
which keeps them identifiable. `soft` has low gains and more of that torque, held for each frame, as
a controller would; `soft-hanging` does so around the hanging position; `free` lets the plant swing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from koop_clients.mechanics.simulation import FRAME_INTERVAL, STEP, Policy, State, hold
from koop_clients.mechanics.systems import System

Regime = Literal["free", "paper", "probing", "soft", "soft-hanging"]

# Where the pole is to be: angle [rad] and its rate [rad/s] as a function of time [s].
Motion = Callable[[float], tuple[float, float]]

TORQUE_BOUND = 30.0  # N m

# Largest amplitude [rad] and frequency [Hz] of each of the three sinusoids of a reference (A.2.1).
_PAPER_REFERENCE = {"pendulum": (np.pi / 3, 0.3), "cartpole": (2 * np.pi / 3, 0.1)}

# Of the probing and soft regimes: the region around upright in which control acts.
_NEAR_REFERENCE = (0.6, 0.4)

_PAPER_GAINS = (100.0, 10.0)  # N m/rad, N m s/rad
_PROBING_TORQUE = 3.0  # N m, standard deviation

# Of the soft regime: N m/rad, N m s/rad, and the multisine's standard deviation [N m].
_SOFT_GAINS = {
    "pendulum": (15.0, 2.5, 4.0),
    "double-pendulum": (15.0, 2.5, 4.0),
    "cartpole": (25.0, 5.0, 6.0),
}
_MULTISINE_TERMS, _MULTISINE_BAND = 6, (0.3, 3.0)  # Hz


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


@dataclass(frozen=True)
class Rest:
    """A reference that stays at one angle [rad]."""

    angle: float

    def __call__(self, time: float) -> tuple[float, float]:  # noqa: ARG002
        """Angle [rad] and its rate [rad/s] at `time` [s]."""
        return self.angle, 0.0


@dataclass(frozen=True, eq=False)
class Passage:
    """A smooth way from one reference to another, beginning at `begin`, `duration` long [s]."""

    start: Motion
    end: Motion
    begin: float
    duration: float

    def __call__(self, time: float) -> tuple[float, float]:
        """Angle [rad] and its rate [rad/s] at `time` [s]."""
        x = min(max((time - self.begin) / self.duration, 0.0), 1.0)
        share, rising = x * x * (3 - 2 * x), 6 * x * (1 - x) / self.duration
        (a, a_rate), (b, b_rate) = self.start(time), self.end(time)
        return a + share * (b - a), a_rate + share * (b_rate - a_rate) + rising * (b - a)


@dataclass(frozen=True, eq=False)
class Multisine:
    """A sum of sinusoids: amplitudes [N m], angular rates [rad/s], phases [rad]."""

    amplitude: np.ndarray
    rate: np.ndarray
    phase: np.ndarray

    def __call__(self, time: float) -> float:
        """Torque [N m] at `time` [s]."""
        return float(np.sum(self.amplitude * np.sin(self.rate * time + self.phase)))


@dataclass(frozen=True, eq=False)
class Tracking:
    """PD tracking of a reference (eq. 15), with a torque on top, optionally held for each frame.

    `gains` are N m/rad and N m s/rad.
    """

    system: System
    reference: Motion
    gains: tuple[float, float]
    extra: Multisine | None = None
    hold_frame: bool = False

    def policy(self) -> Policy:
        """The torque law; with `hold_frame` it is computed once, at each frame's first step."""
        held = [0.0]

        def torque(number: int, step: int, state: State) -> float:
            if step == 0 or not self.hold_frame:
                held[0] = self._torque(number * FRAME_INTERVAL + step * STEP, state)
            return held[0]

        return torque

    def _torque(self, time: float, state: State) -> float:
        angle, rate = self.reference(time)
        pole = self.system.pole
        proportional, derivative = self.gains
        torque = -proportional * (state.q[pole] - angle) - derivative * (state.v[pole] - rate)
        if self.extra is not None:
            torque += self.extra(time)
        return float(np.clip(torque, -TORQUE_BOUND, TORQUE_BOUND))


def excitation(
    system: System, regime: Regime, rng: np.random.Generator
) -> tuple[Policy, Reference | None]:
    """The torque law of a regime, and the reference that it tracks (None when free)."""
    if regime == "free":
        return hold(0.0), None
    if regime == "paper":
        limits = _PAPER_REFERENCE.get(system.name, _PAPER_REFERENCE["pendulum"])
        reference = _sample_reference(rng, *limits)
        return Tracking(system, reference, _PAPER_GAINS).policy(), reference
    reference = near_reference(rng, np.pi if regime == "soft-hanging" else 0.0)
    tracking = probing_tracking if regime == "probing" else soft_tracking
    return tracking(system, reference, rng).policy(), reference


def near_reference(rng: np.random.Generator, centre: float) -> Reference:
    """A random reference around `centre` [rad], of the probing and soft regimes."""
    return _sample_reference(rng, *_NEAR_REFERENCE, centre)


def probing_tracking(system: System, reference: Motion, rng: np.random.Generator) -> Tracking:
    """The `probing` regime around a reference of the caller's."""
    return Tracking(system, reference, _PAPER_GAINS, _sample_multisine(rng, _PROBING_TORQUE))


def soft_tracking(
    system: System, reference: Reference, rng: np.random.Generator, share: float = 1.0
) -> Tracking:
    """The `soft` regime around a reference of the caller's, with a share of its extra torque."""
    proportional, derivative, spread = _SOFT_GAINS[system.name]
    extra = _sample_multisine(rng, share * spread)
    return Tracking(system, reference, (proportional, derivative), extra, hold_frame=True)


def _sample_reference(
    rng: np.random.Generator, amplitude: float, frequency: float, centre: float = 0.0
) -> Reference:
    return Reference(
        rng.uniform(0, amplitude, 3),
        2 * np.pi * rng.uniform(0, frequency, 3),
        rng.uniform(0, 2 * np.pi, 3),
        centre,
    )


def _sample_multisine(rng: np.random.Generator, spread: float) -> Multisine:
    terms = _MULTISINE_TERMS
    return Multisine(
        np.full(terms, spread * np.sqrt(2 / terms)),
        2 * np.pi * rng.uniform(*_MULTISINE_BAND, terms),
        rng.uniform(0, 2 * np.pi, terms),
    )
