"""Which trajectories have been in use, and for how long they have not."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from itertools import islice, takewhile


class Residence:
    """Names in the order of their last use, and when that was."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._used: OrderedDict[str, float] = OrderedDict()

    def touch(self, name: str) -> None:
        """It is used now."""
        self._used[name] = self._clock()
        self._used.move_to_end(name)

    def remove(self, name: str) -> None:
        """It is not there any more."""
        self._used.pop(name, None)

    def longest_idle(self, spared: Callable[[str], bool]) -> str | None:
        """The one whose last use is longest ago, of those that are not spared."""
        return next((name for name in self._used if not spared(name)), None)

    def idle_for(self, seconds: float, most: int) -> list[str]:
        """Those that were not used for so long, `most` of them, longest ago first."""
        latest = self._clock() - seconds
        idle = takewhile(lambda item: item[1] <= latest, self._used.items())
        return [name for name, _ in islice(idle, most)]
