"""A bank of estimators with equal settings: what the pipeline calls, one lane a trajectory.

It knows neither names nor epochs nor time: the caller keeps which trajectory holds which lane, and
folds the transitions (w, y) that `stream.py` joined. Not for several threads at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .compiled import Array, Integers
from .factor import Factor, check, init
from .factor_batch import FactorBatch
from .innovation import RECENT, InnovationStatistics
from .interleaved import DENSE, LANES
from .posterior import excitation
from .settings import EstimatorSettings

#: A lane's state as plain values, to be written down and read back: see `Bank.snapshot`.
Snapshot = dict[str, Array | int]


@dataclass(frozen=True)
class LaneStatus:
    """How far a lane has learned.

    updates: transitions folded. warmup_updates: how many make it ready.
    residual_rms: root mean square of the one-step residual, in code units (0 until ready).
    excitation: see `posterior.excitation`; 1 where some direction was never excited.
    """

    updates: int
    warmup_updates: int
    residual_rms: float
    excitation: float

    @property
    def ready(self) -> bool:
        return self.updates >= self.warmup_updates


class Bank:
    """Lanes are opened and closed as trajectories come and go; room is made as needed."""

    def __init__(self, settings: EstimatorSettings, capacity: int = LANES) -> None:
        self.settings = settings
        self._factors = FactorBatch(settings, capacity)
        self._statistics = InnovationStatistics(settings, self._factors.capacity)
        self._open: set[int] = set()
        self._free = list(range(self._factors.capacity - 1, -1, -1))

    def __len__(self) -> int:
        """Lanes open."""
        return len(self._open)

    def open(self) -> int:
        """A lane that holds the prior alone; the lowest of those closed last, else a new one."""
        if not self._free:
            self._grow()
        lane = self._free.pop()
        self._open.add(lane)
        return lane

    def close(self, lane: int) -> None:
        """Forget what the lane learned and give it back."""
        self.reset(lane)
        self._open.remove(lane)
        self._free.append(lane)

    def compact(self) -> dict[int, int]:
        """Give memory back where three quarters of the lanes or more are closed.

        Returns the lanes that have moved, old to new; their bits are what they were.
        """
        capacity = self._factors.capacity
        while capacity > LANES and 4 * len(self._open) <= capacity:
            capacity = max(LANES, -(-capacity // (2 * LANES)) * LANES)
        if capacity == self._factors.capacity:
            return {}
        free = [lane for lane in range(capacity) if lane not in self._open]
        beyond = sorted(lane for lane in self._open if lane >= capacity)
        moved = dict(zip(beyond, free, strict=False))
        for old, new in moved.items():
            self._move(old, new)
        self._factors.shrink(capacity)
        self._statistics.shrink(capacity)
        self._free = free[len(moved) :][::-1]
        return moved

    def _move(self, old: int, new: int) -> None:
        self._factors.insert(new, self._factors.extract(old))
        statistics = self._statistics
        statistics.insert(
            new, statistics.covariance(old), statistics.seen(old), statistics.ring(old)
        )
        self._open.remove(old)
        self._open.add(new)

    def reset(self, lane: int) -> None:
        """Back to the prior, for a new epoch of the same trajectory."""
        self._require_open(lane)
        n = self.settings.code_size
        self._put(lane, init(self.settings), np.zeros((n, n)), 0, np.zeros((RECENT, n)))

    def fold(self, lanes: Integers, W: Array, Y: Array) -> Array:
        """Fold transition b, W[b] (d,) -> Y[b] (n,), into lane lanes[b] for all b of B, in order.

        Returns the normalised innovations E (B, n). Raises ValueError, and changes nothing, for
        wrong shapes, lanes that are not open and numbers that are not finite.
        """
        lanes = np.asarray(lanes, dtype=np.int64)
        for lane in set(lanes.ravel().tolist()) - self._open:
            self._require_open(lane)
        E = self._factors.update(lanes, W, Y)
        self._statistics.fold(lanes, E)
        return E

    def theta(self, lane: int) -> Array:
        """Theta (n, d), solved now; rows of [A_1 ... A_h B c]."""
        self._require_open(lane)
        return self._factors.theta(lane)

    def factor(self, lane: int) -> Factor:
        """A copy of the lane's factor, for `posterior`'s functions."""
        self._require_open(lane)
        return self._factors.extract(lane)

    def covariance(self, lane: int) -> Array:
        """S (n, n), covariance of the one-step residual; zero until the warm-up is over."""
        self._require_open(lane)
        return self._statistics.covariance(lane)

    def innovations(self, lane: int) -> Array:
        """The newest normalised innovations (K, n), oldest first; K up to 10, 0 until warmed up."""
        self._require_open(lane)
        return self._statistics.recent(lane)

    def updates(self, lane: int) -> int:
        """Transitions folded since the lane was opened or reset."""
        self._require_open(lane)
        return self._statistics.seen(lane)

    def ready(self, lane: int) -> bool:
        """Enough transitions were folded for the model to be used."""
        return self.updates(lane) >= self.settings.warmup_updates

    def status(self, lane: int) -> LaneStatus:
        """How far the lane has learned; costs a singular value decomposition of R."""
        return LaneStatus(
            updates=self.updates(lane),
            warmup_updates=self.settings.warmup_updates,
            residual_rms=self._statistics.rms(lane),
            excitation=excitation(self.factor(lane).R, self.settings.rho),
        )

    def snapshot(self, lane: int) -> Snapshot:
        """The lane's whole state as arrays and integers; `restore` gives back the same bits."""
        factor = self.factor(lane)
        return {
            "rows": factor.rows,
            "anchor": factor.anchor,
            "centre": factor.centre,
            "ring": factor.ring,
            "steps": factor.steps,
            "covariance": self._statistics.covariance(lane),
            "innovations": self._statistics.ring(lane),
            "updates": self._statistics.seen(lane),
        }

    def restore(self, lane: int, snapshot: Mapping[str, Array | int]) -> None:
        """Continue from a snapshot of a bank with equal settings.

        Raises ValueError, and changes nothing, where it is incomplete or of other sizes.
        """
        self._require_open(lane)
        missing = self.snapshot(lane).keys() - snapshot.keys()
        if missing:
            raise ValueError(f"the snapshot lacks {sorted(missing)}; expected what snapshot gives")
        array = {name: np.array(snapshot[name], dtype=np.float64) for name in _ARRAYS}
        factor = Factor(
            array["rows"],
            array["rows"][-2:-1, :0],
            array["anchor"],
            array["centre"],
            array["ring"],
            int(snapshot["steps"]),
        )
        updates = int(snapshot["updates"])
        self._put(lane, factor, array["covariance"], updates, array["innovations"])

    def _put(
        self, lane: int, factor: Factor, covariance: Array, updates: int, innovations: Array
    ) -> None:
        check(self.settings, factor)
        self._statistics.insert(lane, covariance, updates, innovations)
        self._factors.insert(lane, factor)

    def _grow(self) -> None:
        before = self._factors.capacity
        self._factors.grow(2 * before)
        self._statistics.grow(self._factors.capacity)
        self._free.extend(range(self._factors.capacity - 1, before - 1, -1))

    def _require_open(self, lane: int) -> None:
        if lane not in self._open:
            raise ValueError(f"lane {lane} is not open; expected one that open() gave")


_ARRAYS = ("rows", "anchor", "centre", "ring", "covariance", "innovations")


def warm_up(settings: EstimatorSettings) -> None:
    """Compile (or load from the cache) every kernel, so that no frame waits for it."""
    bank = Bank(settings)
    lanes = np.array([bank.open() for _ in range(DENSE)])
    W, Y = np.zeros((DENSE, settings.regressor_size)), np.zeros((DENSE, settings.code_size))
    bank.fold(lanes, W, Y)
    bank.fold(lanes[:1], W[:1], Y[:1])
    bank.theta(int(lanes[0]))
