"""Watches the memory of the process, as the system counts it when it runs out."""

from __future__ import annotations

import time
from collections.abc import Callable

from koop_service.serving.admission.strain import Strain
from koop_service.serving.instruments.process import own_bytes

_EVERY = 0.5
"""Seconds between two looks."""


class Memory:
    """Compares the process's own memory with `limit` [bytes], 0 for none, for the strain."""

    def __init__(
        self,
        limit: int,
        strain: Strain,
        read: Callable[[], int] = own_bytes,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.strain = strain
        self._limit = limit
        self._read = read
        self._clock = clock
        self._next = clock()

    def observe(self) -> None:
        """Look, where it is time."""
        if self._limit and self._clock() >= self._next:
            self._next = self._clock() + _EVERY
            self.strain.observe(self._read() / self._limit)
