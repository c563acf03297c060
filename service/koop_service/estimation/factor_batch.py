"""The factors of many streams, interleaved: 64 lanes side by side, the lane index last.

A block of 64 lanes holds their [R D], packed (row i from column i on), as (packed, 64): one Givens
rotation then works on 64 streams at once. Which measurements come together in a call decides only
how they are computed: where few lanes of a block have one, each is taken out and updated alone.
Both ways do the same operations in the same order, so a lane's bits depend on its own measurements
only, and equal those of `factor.update`. A lane without a measurement rotates in a row of zeros,
which changes no bit of it.
"""

from dataclasses import dataclass

import numpy as np

from .compiled import Array, Integers
from .factor import LARGEST, Factor, check, init
from .interleaved import LANES, count_unfit, fold_all, gather, scatter
from .proximal import solve
from .settings import EstimatorSettings


@dataclass(slots=True, eq=False)
class _Arrays:
    """Everything the lanes hold, for a capacity C, a multiple of 64.

    blocks (C/64, packed, 64); anchor, centre and ring (C, ..): see `Factor`; steps (C,).
    """

    blocks: Array
    anchor: Array
    centre: Array
    ring: Array
    steps: Integers


class FactorBatch:
    """Factors of up to `capacity` streams with equal settings, addressed by lane (0 ..)."""

    def __init__(self, settings: EstimatorSettings, capacity: int = LANES) -> None:
        self.settings = settings
        self._arrays = _new_arrays(settings, 0)
        self._scratch = np.zeros((settings.row_size + 3, LANES))
        self._rows = init(settings).rows
        self.grow(capacity)

    @property
    def capacity(self) -> int:
        return len(self._arrays.steps)

    def grow(self, capacity: int) -> None:
        """Make room for at least `capacity` lanes; the new ones hold the prior alone."""
        missing = -(-(capacity - self.capacity) // LANES)
        if missing <= 0:
            return
        old, new = self._arrays, _new_arrays(self.settings, missing)
        self._arrays = _Arrays(
            np.concatenate([old.blocks, new.blocks]),
            np.concatenate([old.anchor, new.anchor]),
            np.concatenate([old.centre, new.centre]),
            np.concatenate([old.ring, new.ring]),
            np.concatenate([old.steps, new.steps]),
        )

    def shrink(self, capacity: int) -> None:
        """Give back the memory of the lanes from `capacity`, a multiple of 64, on."""
        old = self._arrays
        self._arrays = _Arrays(
            old.blocks[: capacity // LANES].copy(),
            old.anchor[:capacity].copy(),
            old.centre[:capacity].copy(),
            old.ring[:capacity].copy(),
            old.steps[:capacity].copy(),
        )

    def update(self, lanes: Integers, W: Array, Y: Array) -> Array:
        """Fold measurement b, W[b] (d,) and Y[b] (n,), into lane lanes[b], for all b of B.

        A lane may occur several times: its measurements are folded in their order.
        Returns the normalised innovations E (B, n).
        Raises ValueError (and changes nothing) for wrong shapes, unknown lanes and numbers that
        are not finite.
        """
        self._check(lanes, W, Y)
        E = np.empty(Y.shape)
        arrays, settings = self._arrays, self.settings
        fold_all(
            arrays.blocks,
            arrays.anchor,
            arrays.centre,
            arrays.ring,
            arrays.steps,
            np.ascontiguousarray(lanes, dtype=np.int64),
            np.ascontiguousarray(W, dtype=np.float64),
            np.ascontiguousarray(Y, dtype=np.float64),
            E,
            self._scratch,
            self._rows,
            settings.rho,
            settings.forgetting,
            settings.refill_stride,
            settings.refill_losses,
        )
        return E

    def _check(self, lanes: Integers, W: Array, Y: Array) -> None:
        d, n, B = self.settings.regressor_size, self.settings.code_size, lanes.size
        if lanes.ndim != 1 or W.shape != (B, d) or Y.shape != (B, n):
            raise ValueError(
                f"lanes, W and Y have shapes {lanes.shape}, {W.shape} and {Y.shape};"
                f" expected (B,), (B, {d}) and (B, {n})"
            )
        if B and not (lanes.min() >= 0 and lanes.max() < self.capacity):
            raise ValueError(f"lanes are {lanes}; expected 0 to {self.capacity - 1}")
        for name, rows in (("W", W), ("Y", Y)):
            if count_unfit(np.ravel(rows), LARGEST):
                b = int(np.argmin(np.all(np.abs(rows) <= LARGEST, axis=1)))
                raise ValueError(
                    f"{name}[{b}], for lane {lanes[b]}, holds a number that is not finite;"
                    f" expected magnitudes up to {LARGEST:g}"
                )

    def theta(self, lane: int) -> Array:
        """Theta (n, d) of a lane, solved now."""
        d, rows = self.settings.regressor_size, self._rows
        block, column = self._place(lane)
        gather(self._arrays.blocks[block], column, rows, d)
        rho, iterations = self.settings.rho, self.settings.solve_iterations
        return solve(rows[:d, :d], rows[:d, d:], rho, iterations, self.settings.centre)

    def extract(self, lane: int) -> Factor:
        """A copy of the lane's factor, as the single-stream value."""
        block, column = self._place(lane)
        arrays, d = self._arrays, self.settings.regressor_size
        rows = np.zeros(self._rows.shape)
        gather(arrays.blocks[block], column, rows, d)
        return Factor(
            rows,
            rows[d, d:],
            arrays.anchor[lane].copy(),
            arrays.centre[lane].copy(),
            arrays.ring[lane].copy(),
            int(arrays.steps[lane]),
        )

    def insert(self, lane: int, factor: Factor) -> None:
        """Put a factor into a lane; raises ValueError where it does not fit the settings."""
        block, column = self._place(lane)
        check(self.settings, factor)
        arrays = self._arrays
        scatter(factor.rows + 0.0, arrays.blocks[block], column, self.settings.regressor_size)
        arrays.anchor[lane] = factor.anchor
        arrays.centre[lane] = factor.centre
        arrays.ring[lane] = factor.ring
        arrays.steps[lane] = factor.steps

    def reset(self, lane: int) -> None:
        """Back to the prior alone."""
        self.insert(lane, init(self.settings))

    def _place(self, lane: int) -> tuple[int, int]:
        if not 0 <= lane < self.capacity:
            raise ValueError(f"lane is {lane}; expected 0 to {self.capacity - 1}")
        return divmod(lane, LANES)


def _new_arrays(settings: EstimatorSettings, blocks: int) -> _Arrays:
    """The prior alone in every lane."""
    d, one, C = settings.regressor_size, init(settings), blocks * LANES
    packed = np.concatenate([row[i:] for i, row in enumerate(one.rows[:d])])
    return _Arrays(
        blocks=np.tile(packed[:, None], (blocks, 1, LANES)),
        anchor=np.tile(one.anchor, (C, 1, 1)),
        centre=np.tile(one.centre, (C, 1, 1)),
        ring=np.tile(one.ring, (C, 1, 1)),
        steps=np.zeros(C, dtype=np.int64),
    )
