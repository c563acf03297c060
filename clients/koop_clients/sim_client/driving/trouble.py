"""Torques on the pole's joint that the service does not see: a kick, and noise."""

from __future__ import annotations

import numpy as np

from koop_clients.mechanics.simulation import FRAME_INTERVAL, STEP, STEPS_PER_FRAME, Disturbance
from koop_clients.sim_client.options import TroubleOptions


def disturbance(options: TroubleOptions, begin: int, seed: tuple[int, ...]) -> Disturbance:
    """What disturbs a drive that begins at frame `begin`; a pure function of time and seed."""
    kick_step = begin * STEPS_PER_FRAME + round(options.kick_at / STEP)

    def torque(number: int, step: int) -> float:
        at_once = number * STEPS_PER_FRAME + step == kick_step
        kick = options.kick / STEP if at_once else 0.0  # an impulse, in one step
        return kick + _noise(options.noise, number, seed)

    return torque


def mass_change_frame(options: TroubleOptions, begin: int) -> int | None:
    """Number of the frame at which the mass changes, if it does."""
    if options.change_mass_at is None:
        return None
    return begin + round(options.change_mass_at / FRAME_INTERVAL)


def _noise(spread: float, number: int, seed: tuple[int, ...]) -> float:
    if spread == 0:
        return 0.0
    return float(np.random.default_rng((*seed, number)).normal(0.0, spread))
