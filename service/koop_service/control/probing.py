"""Inputs that let B be learned: rich, harmless, and the same for the same seed."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .bounds import control_range, rate_range

Array = NDArray[np.float64]

#: Amplitude of a probing input, as a share of the bounds' half width.
SHARE = 0.5


def multisine(
    steps: int,
    control_size: int,
    u_min: ArrayLike | None = None,
    u_max: ArrayLike | None = None,
    du_min: ArrayLike | None = None,
    du_max: ArrayLike | None = None,
    *,
    share: float = SHARE,
    seed: int = 0,
) -> Array:
    """Controls (steps, p): each channel a sum of sines about the middle of its bounds.

    Frequencies are the multiples of 1/steps up to a quarter of the frame rate, dealt to the
    channels in turn: over `steps` they are uncorrelated. Random phases keep the peaks low. The
    amplitude is `share` of the half width (of 1 where a side is unbounded), less where the rates
    ask for it, for a start at the middle too. Raises ValueError as `build_lqr` does.
    """
    if steps < 1 or not 0.0 < share <= 1.0:
        raise ValueError(f"steps is {steps} and share {share}; expected 1 or more, and (0, 1]")
    lower, upper = control_range(u_min, u_max, control_size)
    slowest, fastest = rate_range(du_min, du_max, control_size)
    middle, reach = middle_and_reach(lower, upper)
    waves = _waves(steps, control_size, np.random.default_rng(seed))
    change = np.abs(np.diff(waves, axis=0, prepend=0.0)).max(axis=0)
    allowed = np.minimum(-slowest, fastest)
    with np.errstate(divide="ignore", invalid="ignore"):
        amplitude = np.fmin(share * reach, allowed / change)
    return middle + amplitude * waves


def middle_and_reach(lower: Array, upper: Array) -> tuple[Array, Array]:
    """Middle and half width (p,) of bounds; of open ones 1, about a middle as near 0 as may be."""
    with np.errstate(invalid="ignore"):
        middle, reach = 0.5 * (lower + upper), 0.5 * (upper - lower)
    near = np.minimum(np.maximum(0.0, lower + 1.0), upper - 1.0)
    closed = np.isfinite(reach)
    return np.where(closed, middle, near), np.where(closed, reach, 1.0)


def _waves(steps: int, control_size: int, rng: np.random.Generator) -> Array:
    """(steps, p) sums of sines with peaks at 1, each begun where it is nearest to zero."""
    turns = 2.0 * np.pi * np.arange(steps) / steps
    highest = max(steps // 4, control_size)
    waves = np.empty((steps, control_size))
    for channel in range(control_size):
        multiples = np.arange(channel + 1, highest + 1, control_size)
        phases = rng.uniform(0.0, 2.0 * np.pi, len(multiples))
        wave = np.cos(np.outer(turns, multiples) + phases).sum(axis=1)
        wave = np.roll(wave, -int(np.argmin(np.abs(wave))))
        waves[:, channel] = wave / np.abs(wave).max()
    return waves
