"""Drives of wakes on disk: what figures are drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True, eq=False)
class FlowRecord:
    """N drives, frame by frame.

    Attributes:
        momenta: (T, H, W) momentum along the stream in the first one, over the free stream's.
        target: (H, W) the same of the steady flow.
        probes: (N, T) transverse velocity behind the cylinder [U]; NaN where one was shorter.
        rotations: (N, T) rotation in the interval that follows [U/D].
        natural: largest |v| behind a cylinder at rest [U].
    """

    momenta: np.ndarray
    target: np.ndarray
    probes: np.ndarray
    rotations: np.ndarray
    natural: float

    def save(self, path: Path) -> None:
        """Write a NumPy .npz with these names."""
        np.savez_compressed(
            path,
            momenta=self.momenta,
            target=self.target,
            probes=self.probes,
            rotations=self.rotations,
            natural=self.natural,
        )
