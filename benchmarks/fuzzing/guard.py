"""A target under watch: what one input may cost, in memory and in time."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

Target = Callable[[bytes], bool]
"""Takes any bytes, returns whether they meant something, and raises nothing."""

_FIRST, _RARELY = 100_000, 256
"""After so many inputs the memory of so many times fewer of them is looked at."""


class BrokenError(AssertionError):
    """A target took more than an input of its size may cost."""


@dataclass
class Guard:
    """Calls a target, and looks at the memory of every `stride`-th input.

    After the first ones it looks less often: tracemalloc itself keeps a kilobyte of each look.

    fixed, per_byte: what the peak of traced memory may be [bytes]; 256 KiB are msgpack's buffer for
    whatever it packs. seconds: what one input may take of the processor. accepted: inputs that
    meant something. slowest [s], largest [bytes].
    """

    target: Target
    stride: int = 16
    fixed: int = 512 << 10
    per_byte: int = 16
    seconds: float = 2.0
    runs: int = 0
    accepted: int = 0
    slowest: float = 0.0
    largest: int = 0

    def __call__(self, data: bytes) -> None:
        """Raises whatever the target does, and BrokenError."""
        self.runs += 1
        start = time.thread_time()
        self.accepted += self.target(data)
        took = time.thread_time() - start
        self.slowest = max(self.slowest, took)
        if took > self.seconds:
            raise BrokenError(f"an input of {len(data)} bytes took {took:.1f} s of the processor")
        rarely = _RARELY if self.runs > _FIRST else 1
        if self.runs % (self.stride * rarely) == 0:
            self._weigh(data)

    def _weigh(self, data: bytes) -> None:
        """Run it again, traced; twice where it is too much, since Python's own tables grow too."""
        most = self.fixed + self.per_byte * len(data)
        peak = self._peak(data)
        if peak > most:
            peak = min(peak, self._peak(data))
        self.largest = max(self.largest, peak)
        if peak > most:
            raise BrokenError(f"an input of {len(data)} bytes took {peak} bytes of memory")

    def _peak(self, data: bytes) -> int:
        tracemalloc.start()
        try:
            self.target(data)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
