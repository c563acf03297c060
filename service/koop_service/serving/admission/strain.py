"""When there is too much of something: predictions are shed first, measurements never.

A strain begins when a level comes near its limit and is over once the level has stayed well below
it for a while, so that it is two lines in the log and not one a query.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from koop_protocol import OVERLOADED, SHORT_OF_MEMORY, ErrorCode, ProtocolError
from koop_service.serving.instruments.metrics import Metrics

log = logging.getLogger("koop.overload")

RETRY_AFTER = 1.0
"""What a caller is told to wait [s]; a strain lasts as long at least."""


@dataclass(frozen=True)
class Bounds:
    """Levels relative to the limit, 1. calm: for how long the level stays below `end` [s]."""

    begin: float
    end: float
    calm: float = RETRY_AFTER


@dataclass(frozen=True)
class Kind:
    """A word for programs, and what a person reads."""

    word: str
    cause: str
    bounds: Bounds


QUEUE = Kind(OVERLOADED, "measurements come faster than they are folded", Bounds(0.5, 0.25))
"""Sources are held back at 1: predictions make room long before."""
MEMORY = Kind(SHORT_OF_MEMORY, "the process is near its limit of memory", Bounds(1.0, 0.95))


class Strain:
    """Watches one level, in the pipeline's thread; any may read `active`, one at a time refuse."""

    def __init__(
        self, kind: Kind, metrics: Metrics, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.kind = kind
        self._metrics = metrics
        self._clock = clock
        self._since: float | None = None
        self._calm_since: float | None = None
        self._shed = 0

    @property
    def active(self) -> bool:
        """Whether there is too much at present."""
        return self._since is not None

    def observe(self, level: float) -> None:
        """Take note of the present level, 1 at the limit."""
        now, bounds = self._clock(), self.kind.bounds
        if self._since is None:
            if level >= bounds.begin:
                self._begin(now)
        elif level >= bounds.end:
            self._calm_since = None
        elif self._calm_since is None:
            self._calm_since = now
        elif now - self._calm_since >= bounds.calm:
            self._end(now - self._since)

    def refuse(self) -> ProtocolError:
        """What to tell somebody whose request is shed; it is counted."""
        self._shed += 1
        self._metrics.shed.labels(self.kind.word).inc()
        return ProtocolError(
            ErrorCode.overloaded,
            self.kind.cause,
            "what costs less, such as the codes of one trajectory: that is still answered",
            f"ask again in {RETRY_AFTER:g} s, or for codes only",
            {"reason": self.kind.word, "retry_after": RETRY_AFTER},
        )

    def _begin(self, now: float) -> None:
        self._since, self._calm_since, self._shed = now, None, 0
        log.warning(
            "%s: predictions of pictures, of deviations and by wildcard are refused until it is "
            "over",
            self.kind.cause,
            extra={"reason": self.kind.word},
        )

    def _end(self, lasted: float) -> None:
        self._since = None
        log.info(
            "it is over after %.1f s that %s; %d requests were refused",
            lasted,
            self.kind.cause,
            self._shed,
            extra={"reason": self.kind.word, "seconds": round(lasted, 3), "refused": self._shed},
        )
