"""How the cylinder turns: rich schedules that identify a model, and the reference controller.

A law gives the rotation [U/D] from the frame's number and the transverse velocity [U] at the probe.
It is held until the next frame. Schedules know the number alone; they are pure functions of their
seed and of it, so that any frame's rotation can be known ahead.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Literal

import numpy as np

from koop_clients.flow.settings import MAX_ROTATION, MORTON_SPEED, FlowSettings

Law = Callable[[int, float], float]
Regime = Literal["rest", "chirp", "sweeps", "schedule", "feedback", "mix"]

# Of one trajectory, such as (seed of the run, number of the trajectory).
Seed = tuple[int, ...]

GAIN = 0.8  # [1/D]; rotation over transverse velocity

_PIECE = 64  # frames of a chirp, of a row of holds, or at rest
_KINDS, _SHARES = ("chirp", "holds", "rest"), (0.5, 0.4, 0.1)
_SMALLEST, _LARGEST = 0.1, 2.0  # U/D, of an amplitude before it is cut: one in four is full
_FASTEST = 0.25  # cycles a frame: twice as fast as the wake sheds
_LONGEST_HOLD = 16  # frames
_SWEEP, _PAUSE = 256, 28  # frames of a slow chirp with the pause at its end, and of that
_SLOWEST = 0.02  # cycles a frame by which its frequency changes, at most; the paper's by 0.012
_EPISODE = 256  # frames: what the reference controller needs to calm the wake
_STIR = 0.15  # share of a schedule that acts on top of the controller


def law(regime: Regime, seed: Seed) -> Law:
    """How a regime turns the cylinder.

    rest does not. chirp is the one long sweep of Morton et al., the paper's forcing, which knows no
    seed: it brings the wake into step, so that from about frame 1,500 on every trajectory is the
    same. sweeps are chirps as slow, of many frequencies and amplitudes. schedule alternates faster
    chirps, random holds and pauses. feedback lets the reference controller calm the wake under a
    weak schedule; what a learned controller will meet. mix takes schedule and feedback in turn.
    """
    if regime == "rest":
        return lambda _number, _probe: 0.0
    if regime == "chirp":
        return lambda number, _probe: chirp(number * FlowSettings().frame_time)
    if regime == "sweeps":
        return lambda number, _probe: _sweep(seed, number // _SWEEP)[number % _SWEEP]
    scheduled, stirred = schedule(seed), feedback(stir=seed)
    if regime == "mix":
        return lambda n, probe: (stirred if n // _EPISODE % 2 else scheduled)(n, probe)
    return scheduled if regime == "schedule" else stirred


def chirp(time: float) -> float:
    """Rotation [U/D] at a time [D/U] of the chirp that Morton et al. trained on.

    0.3 sin(2 pi t^2 / 500,000) in their units, and none in the last tenth of every 1,000; 5,000
    frames sweep from nothing to about twice the frequency that the wake sheds at.
    """
    theirs = time / MORTON_SPEED
    if theirs % 1000 > 900:
        return 0.0
    return MAX_ROTATION * math.sin(2 * math.pi * theirs**2 / 500_000)


def schedule(seed: Seed) -> Law:
    """Chirps, random holds and pauses of 64 frames each, |rotation| <= MAX_ROTATION."""
    return lambda number, _probe: _piece(seed, number // _PIECE)[number % _PIECE]


def feedback(gain: float = GAIN, bound: float = MAX_ROTATION, stir: Seed | None = None) -> Law:
    """The reference controller: rotation = gain v(2.14, 0), clipped to +-`bound` [U/D].

    With a seed to `stir`, some of that schedule acts on top.
    """

    def rotation(number: int, probe: float) -> float:
        extra = 0.0 if stir is None else _STIR * schedule(stir)(number, probe)
        return min(max(gain * probe + extra, -bound), bound)

    return rotation


@lru_cache(maxsize=64)
def _piece(seed: Seed, index: int) -> tuple[float, ...]:
    rng = np.random.default_rng((*seed, index))
    kind = rng.choice(_KINDS, p=_SHARES)
    amplitude = math.exp(rng.uniform(math.log(_SMALLEST), math.log(_LARGEST)))
    amplitude = min(amplitude, MAX_ROTATION)
    if kind == "rest":
        return (0.0,) * _PIECE
    shape = _chirp(rng) if kind == "chirp" else _holds(rng)
    return tuple((amplitude * shape).tolist())


@lru_cache(maxsize=16)
def _sweep(seed: Seed, index: int) -> tuple[float, ...]:
    """Half of them at full amplitude."""
    rng = np.random.default_rng((*seed, index))
    amplitude = MAX_ROTATION * min(rng.uniform(0.5, 1.5), 1.0)
    first = rng.uniform(0, _FASTEST)
    last = first + rng.uniform(-_SLOWEST, _SLOWEST)
    turned = amplitude * _sine(first, last, _SWEEP - _PAUSE, rng.uniform())
    return (*turned.tolist(), *[0.0] * _PAUSE)


def _chirp(rng: np.random.Generator) -> np.ndarray:
    """(64,) in [-1, 1]: a sine whose frequency runs from one random value to another."""
    first, last = rng.uniform(0, _FASTEST, 2)
    return _sine(first, last, _PIECE, rng.uniform())


def _sine(first: float, last: float, frames: int, phase: float) -> np.ndarray:
    """(frames,) a sine whose frequency runs from `first` to `last` [cycles a frame]."""
    cycles = np.cumsum(np.linspace(first, last, frames))
    return np.sin(2 * np.pi * (cycles + phase))


def _holds(rng: np.random.Generator) -> np.ndarray:
    """(64,) in [-1, 1]: random levels, each for 1 to 16 frames."""
    lengths = rng.integers(1, _LONGEST_HOLD, _PIECE, endpoint=True)
    return np.repeat(rng.uniform(-1, 1, _PIECE), lengths)[:_PIECE]
