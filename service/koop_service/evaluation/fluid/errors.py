"""How far fields are from the truth: L1 by channel, and what an eye could see of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from koop_service.evaluation.fluid.sequences import Units
from koop_service.evaluation.forecasts import Array

COLOURS = (-0.2, 1.4)
"""x-momentum that a strip's first and last colour stand for [free streams]."""
VISIBLE = 0.05 * (COLOURS[1] - COLOURS[0])
"""An error in x-momentum that an eye may find in a strip [free streams]: 5% of the colours."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Of frames (...): `absolute` (..., C), the mean of each channel in normalised units, and
    `visible` (...), the share of pixels whose x-momentum errs by more than VISIBLE."""

    absolute: Array
    visible: Array

    def on(self, change: Callable[[Array], Array]) -> Errors:
        """Both changed alike along the frames."""
        return Errors(change(self.absolute), change(self.visible))


def compare(pictures: np.ndarray, truth: np.ndarray, units: Units) -> Errors:
    """Errors (K,) of pictures, or of one picture for all, against truth, (K, C, H, W).

    Frame by frame, which stays in the processor's cache.
    """
    threshold = VISIBLE * units.free_stream / units.scale
    absolute = np.empty(truth.shape[:2])
    visible = np.empty(len(truth))
    for k, (picture, frame) in enumerate(
        zip(np.broadcast_to(pictures, truth.shape), truth, strict=True)
    ):
        apart = np.abs(picture - frame.astype(np.float32))
        absolute[k] = apart.mean((-2, -1), dtype=np.float64)
        visible[k] = (apart[units.shown] > threshold).mean()
    return Errors(absolute, visible)


def joined(parts: Sequence[Errors], axis: int) -> Errors:
    """One after the other along an axis of the frames."""
    return Errors(
        np.concatenate([part.absolute for part in parts], axis),
        np.concatenate([part.visible for part in parts], axis),
    )


def stacked(parts: Sequence[Errors]) -> Errors:
    """A new first axis."""
    return Errors(
        np.stack([part.absolute for part in parts]), np.stack([part.visible for part in parts])
    )
