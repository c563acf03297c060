"""Laws that know the plant and its true state: what the service's control is compared with."""

from __future__ import annotations

import numpy as np

from koop_clients.mechanics.linearisation import linearise, stationary_gain
from koop_clients.mechanics.simulation import Policy, State, angle_between
from koop_clients.mechanics.systems import System
from koop_clients.sim_client.driving.outcome import RATE_WEIGHT

_PAPER_GAINS = (100.0, 10.0)  # N m/rad, N m s/rad, of eq. 15


def pd_law(system: System, target: float, bound: float) -> Policy:
    """Eq. 15 with the paper's gains to a target at rest [rad], anew every 5 ms, cut off at `bound`.

    Held for a whole frame such gains would be unstable.
    """
    pole = system.pole
    proportional, derivative = _PAPER_GAINS

    def torque(_number: int, _step: int, state: State) -> float:
        error = float(angle_between(state.q[pole], target))
        return float(np.clip(-proportional * error - derivative * state.v[pole], -bound, bound))

    return torque


def state_lqr_law(system: System, target: float, r: float, bound: float) -> Policy:
    """LQR of the plant linearised at the target [rad], held for each frame, cut off at `bound`.

    Weights: 1 on angles, 0.1 on rates, `r` on the torque, as in a drive's cost.

    Raises:
        ValueError: no torque holds the plant there.
    """
    plant = linearise(system, target)
    poles = len(plant.rest)
    gain = stationary_gain(plant, np.diag([1.0] * poles + [RATE_WEIGHT] * poles), r)
    held = [0.0]

    def torque(_number: int, step: int, state: State) -> float:
        if step == 0:
            wanted = plant.torque - float(gain @ plant.error(state))
            held[0] = float(np.clip(wanted, -bound, bound))
        return held[0]

    return torque
