"""Simulated time against the clock on the wall, and how a run is told to stop."""

from __future__ import annotations

import math
import signal
import time
from types import FrameType

_LONGEST_NAP = 0.1  # s, so that a stop is noticed
_LARGEST_DEBT = 0.5  # s


class Pace:
    """Waits until simulated time is due at `speed` times real time; never, if that is infinite."""

    def __init__(self, speed: float, stop: Stop) -> None:
        self._speed = speed
        self._stop = stop
        self._start = time.monotonic()

    def wait(self, simulated: float) -> None:
        """Wait until `simulated` [s] is due.

        Small delays are made up for; a long one, such as a suspended laptop's, is forgotten.
        """
        if math.isinf(self._speed):
            return
        due = self._start + simulated / self._speed
        late = time.monotonic() - due
        if late > _LARGEST_DEBT:
            self._start += late
        while not self._stop and (rest := due - time.monotonic()) > 0:
            time.sleep(min(rest, _LONGEST_NAP))


class Stop:
    """True once SIGINT or SIGTERM has come; a second SIGINT interrupts at once."""

    def __init__(self) -> None:
        self._stopped = False

    def __bool__(self) -> bool:
        return self._stopped

    def catch_signals(self) -> None:
        """Turn the first Ctrl-C, or a SIGTERM, into a clean stop."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._stopped = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
