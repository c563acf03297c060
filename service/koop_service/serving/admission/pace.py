"""How often predictions may be asked for.

Zenoh does not tell who asks, so clients cannot be told apart; what they ask about can. The limit is
therefore one a key: a client in a tight loop slows down those who ask the same, and nobody else.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable

_WINDOW = 1.0
"""Seconds over which queries are counted."""


class Pace:
    """At most `rate` queries a second of each key; any thread may ask."""

    def __init__(self, rate: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate
        self._clock = clock
        self._lock = threading.Lock()
        self._began = clock()
        self._counts: Counter[str] = Counter()

    def wait(self, key: str) -> float:
        """0 where the query may be answered, else how long to wait before the next [s]."""
        if self._rate == 0:
            return 0.0
        with self._lock:
            now = self._clock()
            if now - self._began >= _WINDOW:
                self._began = now
                self._counts.clear()
            self._counts[key] += 1
            return _WINDOW - (now - self._began) if self._counts[key] > self._rate else 0.0
