"""Residual statistics of each lane from the normalised innovations that the update returns.

e e^T has expectation S, the covariance (n, n) of what one step cannot predict: its exponentially
weighted mean is S. The first `warmup_updates` innovations are left out, they are the prior's.
"""

import numpy as np

from .compiled import Array, Integers, compiled
from .settings import EstimatorSettings

#: Innovations that S remembers (10 s at 20 frames/s), fewer where the factor forgets faster.
MEMORY = 200
#: The newest innovations, which are kept as they are: what is usual now, beside S.
RECENT = 10


class InnovationStatistics:
    """S, its sample count and the newest innovations of up to `capacity` lanes."""

    def __init__(self, settings: EstimatorSettings, capacity: int) -> None:
        self.settings = settings
        self._least_gain = max(1.0 / MEMORY, 1.0 - settings.forgetting)
        self._covariances = np.zeros((0, settings.code_size, settings.code_size))
        self._seen = np.zeros(0, dtype=np.int64)
        self._rings = np.zeros((0, RECENT, settings.code_size))
        self.grow(capacity)

    def grow(self, capacity: int) -> None:
        """Make room for at least `capacity` lanes; the new ones have seen nothing."""
        missing = max(0, capacity - len(self._seen))
        n = self.settings.code_size
        self._covariances = np.concatenate([self._covariances, np.zeros((missing, n, n))])
        self._seen = np.concatenate([self._seen, np.zeros(missing, dtype=np.int64)])
        self._rings = np.concatenate([self._rings, np.zeros((missing, RECENT, n))])

    def shrink(self, capacity: int) -> None:
        """Give back the memory of the lanes from `capacity` on."""
        self._covariances = self._covariances[:capacity].copy()
        self._seen = self._seen[:capacity].copy()
        self._rings = self._rings[:capacity].copy()

    def fold(self, lanes: Integers, E: Array) -> None:
        """Fold innovation E[b] (n,) into lane lanes[b], for all b in their order."""
        average(
            self._covariances,
            self._seen,
            self._rings,
            np.ascontiguousarray(lanes, dtype=np.int64),
            E,
            self.settings.warmup_updates,
            self._least_gain,
        )

    def seen(self, lane: int) -> int:
        """Innovations folded, those of the warm-up included."""
        return int(self._seen[lane])

    def covariance(self, lane: int) -> Array:
        """S (n, n), in units of code squared; zero until the warm-up is over."""
        return self._covariances[lane].copy()

    def ring(self, lane: int) -> Array:
        """(RECENT, n): innovation i after the warm-up stands in row i % RECENT, for `insert`."""
        return self._rings[lane].copy()

    def recent(self, lane: int) -> Array:
        """The newest innovations (K, n) after the warm-up, oldest first; K up to RECENT."""
        counted = max(0, self.seen(lane) - self.settings.warmup_updates)
        kept = np.arange(max(0, counted - RECENT), counted)
        return self._rings[lane, kept % RECENT]

    def rms(self, lane: int) -> float:
        """Root mean square of a code's one-step residual, over time and over the n numbers."""
        return float(np.sqrt(np.trace(self._covariances[lane]) / self.settings.code_size))

    def insert(self, lane: int, covariance: Array, seen: int, ring: Array) -> None:
        """Put back what `covariance`, `seen` and `ring` gave; raises ValueError for other sizes."""
        n = self.settings.code_size
        good = covariance.shape == (n, n) and np.all(np.isfinite(covariance))
        if not good or np.any(np.diag(covariance) < 0.0) or seen < 0:
            raise ValueError(
                f"the covariance has shape {covariance.shape} and {seen} samples;"
                f" expected ({n}, {n}), finite, a diagonal and samples of 0 or more"
            )
        if ring.shape != (RECENT, n) or not np.all(np.isfinite(ring)):
            raise ValueError(
                f"the newest innovations have shape {ring.shape}; expected ({RECENT}, {n}), finite"
            )
        self._covariances[lane] = covariance
        self._seen[lane] = seen
        self._rings[lane] = ring


@compiled
def average(
    covariances: Array,
    seen: Integers,
    rings: Array,
    lanes: Integers,
    E: Array,
    warmup: int,
    least_gain: float,
) -> None:
    """S <- S + gain (e e^T - S): the plain mean at first, then the exponentially weighted one."""
    n = E.shape[1]
    for b in range(lanes.shape[0]):
        lane = lanes[b]
        seen[lane] += 1
        counted = seen[lane] - warmup
        if counted <= 0:
            continue
        gain = max(1.0 / counted, least_gain)
        S, e = covariances[lane], E[b]
        rings[lane, (counted - 1) % rings.shape[1]] = e
        for i in range(n):
            for j in range(n):
                S[i, j] += gain * (e[i] * e[j] - S[i, j])
