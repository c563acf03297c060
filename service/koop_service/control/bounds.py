"""Bounds of eq. 13 on the controls and on how fast they change, and controls that are given."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# A last control may miss its bounds by this much of their size for rounding's sake.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class ControlBounds:
    """lower <= u_t <= upper for t = 0..N-1, rate_lower <= u_t - u_{t-1} <= rate_upper for t >= 1.

    lower, upper: (N, p), in the controls' unit; equal where the control is given, not decided. The
    rate bound from the last applied control to u_0 is in their first row.
    rate_lower, rate_upper: (N-1, p), control units a step; (0, p) where no rate is bounded.
    """

    lower: Array
    upper: Array
    rate_lower: Array
    rate_upper: Array

    @classmethod
    def parse(
        cls,
        horizon: int,
        control_size: int,
        u_min: ArrayLike | None = None,
        u_max: ArrayLike | None = None,
        du_min: ArrayLike | None = None,
        du_max: ArrayLike | None = None,
        last_control: ArrayLike | None = None,
        known: Mapping[int, ArrayLike] | None = None,
    ) -> "ControlBounds":
        """Check the arguments of `build_lqr`; raises ValueError where nothing can satisfy them."""
        N, p = horizon, control_size
        series = known_channels(known, N, p)
        lower, upper = control_range(u_min, u_max, p)
        slowest, fastest = rate_range(du_min, du_max, p)
        start = _last_control(last_control, p)
        for channel in series:  # what is given is neither bounded nor slowed
            slowest[channel], fastest[channel] = -np.inf, np.inf
        lowers, uppers = _repeated(lower, N), _repeated(upper, N)
        if start is not None:
            lowers[0], uppers[0] = first_step(lower, upper, start + slowest, start + fastest)
        for channel, values in series.items():
            lowers[:, channel] = uppers[:, channel] = values
        rows = N - 1 if (np.isfinite(slowest) | np.isfinite(fastest)).any() else 0
        return cls(lowers, uppers, _repeated(slowest, rows), _repeated(fastest, rows))


def known_channels(
    known: Mapping[int, ArrayLike] | None, horizon: int, control_size: int
) -> dict[int, Array]:
    """The given channels' values, (N,) each; a number or a shorter series repeats its last."""
    if not known:
        return {}
    for channel in known:
        if channel not in range(control_size):
            raise ValueError(f"known has channel {channel}; expected 0 to {control_size - 1}")
    if len(known) == control_size:
        raise ValueError("every control channel is known; expected at least one to decide")
    return {channel: _series(channel, values, horizon) for channel, values in known.items()}


def _series(channel: int, values: ArrayLike, horizon: int) -> Array:
    series = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if series.ndim != 1 or series.size == 0 or not np.isfinite(series).all():
        raise ValueError(
            f"known[{channel}] has shape {series.shape}, or a number that is not finite; expected"
            " the channel's future values, one a step"
        )
    return np.concatenate([series[:horizon], np.full(max(0, horizon - len(series)), series[-1])])


def control_range(u_min: ArrayLike | None, u_max: ArrayLike | None, p: int) -> tuple[Array, Array]:
    """Bounds (p,) on a control, infinite where there is none."""
    lower = _bound("u_min", u_min, -np.inf, p)
    upper = _bound("u_max", u_max, np.inf, p)
    if (lower > upper).any() or (lower == np.inf).any() or (upper == -np.inf).any():
        raise ValueError(
            f"u_min is {lower.tolist()} and u_max {upper.tolist()}; expected u_min <= u_max, with a"
            " finite control between them"
        )
    return lower, upper


def rate_range(du_min: ArrayLike | None, du_max: ArrayLike | None, p: int) -> tuple[Array, Array]:
    """Bounds (p,) on a control's change in one step, infinite where there is none."""
    slowest = _bound("du_min", du_min, -np.inf, p)
    fastest = _bound("du_max", du_max, np.inf, p)
    if (slowest > 0.0).any() or (fastest < 0.0).any():
        raise ValueError(
            f"du_min is {slowest.tolist()} and du_max {fastest.tolist()}; expected du_min <= 0 <="
            " du_max, so that a control may stay as it is"
        )
    return slowest, fastest


def _last_control(value: ArrayLike | None, p: int) -> Array | None:
    if value is None:
        return None
    last = np.asarray(value, dtype=np.float64)
    if last.shape not in ((), (p,)) or not np.isfinite(last).all():
        raise ValueError(
            f"last_control is {last.tolist()}; expected a finite number or ({p},): the control that"
            " acts now"
        )
    return np.zeros(p) + last


def first_step(lower: Array, upper: Array, slowest: Array, fastest: Array) -> tuple[Array, Array]:
    """Both bounds on u_0; raises ValueError where one step cannot bring it within its bounds."""
    low, high = np.maximum(lower, slowest), np.minimum(upper, fastest)
    if ((low > high) & (low - high > _ROUNDING * (np.abs(low) + np.abs(high)))).any():
        raise ValueError(
            f"from the last control, u_0 may lie from {slowest.tolist()} to {fastest.tolist()} by"
            f" its rate, and from {lower.tolist()} to {upper.tolist()} by its bounds; expected a"
            " control that satisfies both: allow a faster change, or wider bounds"
        )
    return np.minimum(low, high), high


def _repeated(bound: Array, rows: int) -> Array:
    return np.zeros((rows, 1)) + bound


def _bound(name: str, value: ArrayLike | None, default: float, p: int) -> Array:
    if value is None:
        return np.full(p, default)
    bound = np.asarray(value, dtype=np.float64)
    if bound.shape not in ((), (p,)):
        raise ValueError(f"{name} has shape {bound.shape}; expected a number or ({p},)")
    if np.isnan(bound).any():
        raise ValueError(f"{name} has NaN; expected numbers, infinite where there is no bound")
    return np.zeros(p) + bound
