"""A stream that rests, then moves: how soon is the motion learned?

At rest every code equals z0 and no control acts. Then random controls excite a second-order system
with that fixed point, z_{t+1} = z0 + A_1 (z_{t-1} - z0) + A_2 (z_t - z0) + B u_t, by about 1.
"""

from dataclasses import dataclass

import numpy as np

from koop_service.estimation import factor as single
from koop_service.estimation.factor_batch import FactorBatch
from koop_service.estimation.proximal import solve
from koop_service.estimation.settings import EstimatorSettings

N, P = 8, 1
#: Learned: the one-step error is below this share of the motion's root mean square ...
TOLERANCE = 0.05
#: ... in as many frames in a row. (For good would ask lambda = 0.9, a memory of 10 frames, for more
#: than it can give in 17 dimensions, rest or no rest.)
IN_A_ROW = 10


@dataclass
class Recovery:
    """finite: R and D after the rest are. frames: of motion folded until it was learned."""

    finite: bool
    frames: int


def rest_then_move(forgetting: float, frames: int, z0: np.ndarray, seed: int = 0) -> Recovery:
    """Fold `frames` identical frames, then 200 of motion, with h = 2, n = 8, p = 1 (d = 17)."""
    settings = EstimatorSettings(N, history=2, control_size=P, forgetting=forgetting)
    factor = at_rest(settings, frames, z0)
    finite = bool(np.all(np.isfinite(factor.R)) and np.all(np.isfinite(factor.D)))
    errors, motion = [], []
    for w, y in excited(z0, 200, np.random.default_rng(seed)):
        Theta = solve(factor.R, factor.D, settings.rho, settings.solve_iterations)
        errors.append(np.linalg.norm(y - Theta @ w))
        motion.append(np.linalg.norm(y - z0))
        single.update(factor, settings, w, y)
    good = np.array(errors) < TOLERANCE * np.sqrt(np.mean(np.square(motion)))
    rows = np.lib.stride_tricks.sliding_window_view(good, IN_A_ROW).all(axis=1)
    return Recovery(finite, int(np.argmax(rows)) if rows.any() else len(good))


def at_rest(settings: EstimatorSettings, frames: int, z0: np.ndarray) -> single.Factor:
    """The factor after `frames` frames that all equal z0."""
    batch, w = FactorBatch(settings), np.concatenate([z0, z0, np.zeros(P)])
    while frames > 0:
        B = min(frames, 10_000)
        batch.update(np.zeros(B, dtype=np.int64), np.tile(w, (B, 1)), np.tile(z0, (B, 1)))
        frames -= B
    return batch.extract(0)


def excited(
    z0: np.ndarray, steps: int, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Transitions (w, y) of the motion described above."""
    turn = np.linalg.qr(rng.standard_normal((N, N)))[0]
    A_2 = turn @ np.diag(rng.uniform(-1.2, 1.2, N)) @ turn.T
    A_1 = turn @ np.diag(rng.uniform(-0.8, -0.4, N)) @ turn.T
    B = rng.standard_normal((N, P))
    before, now, transitions = np.zeros(N), np.zeros(N), []
    for _ in range(steps):
        u = rng.standard_normal(P)
        after = A_1 @ before + A_2 @ now + B @ u
        transitions.append((np.concatenate([z0 + before, z0 + now, u]), z0 + after))
        before, now = now, after
    return transitions
