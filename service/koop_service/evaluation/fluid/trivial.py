"""Guesses without a model, which a model has to beat; all know just what they are allowed to.

repeat-last, mean-frame and repeat-period know the fit frames alone, as the offline regime does;
previous-frame and period-ago know every frame before the one they guess, as full updates do.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

_LAGS = range(2, 13)  # frames
_COARSE = 4  # pixels between those that the period is read from


def guesses(
    frames: np.ndarray, fit_frames: int, periodic: bool
) -> Iterator[tuple[str, np.ndarray]]:
    """(name, guesses (K, C, H, W), or (1, C, H, W) for all alike) of the frames after the fit.

    `frames` (T, C, H, W), of which K come after the first `fit_frames`.
    """
    fitted, after = frames[:fit_frames], len(frames) - fit_frames
    yield "repeat-last", fitted[-1:]
    yield "mean-frame", fitted.mean(0, dtype=np.float32, keepdims=True)
    yield "previous-frame", frames[fit_frames - 1 : -1]
    if periodic:
        lag = period_lag(fitted)
        yield "repeat-period", fitted[fit_frames - lag + np.arange(after) % lag]
        yield "period-ago", frames[fit_frames - lag : -lag]


def period_lag(frames: np.ndarray) -> int:
    """After how many frames (K, C, H, W), K over 12, the flow looks most like before (L1)."""
    coarse = frames[..., ::_COARSE, ::_COARSE].astype(np.float32)

    def change(lag: int) -> float:
        return float(np.abs(coarse[lag:] - coarse[:-lag]).mean())

    return min(_LAGS, key=change)
