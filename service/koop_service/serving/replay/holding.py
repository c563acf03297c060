"""Live messages that wait while their trajectories catch up: few, since the logs have them too."""

from __future__ import annotations

from collections import deque

from koop_service.serving.admission.arrivals import Arrival

_EACH = 64
"""Messages held of one trajectory; the newest are worth most, since the log brings the oldest."""


class Holding:
    """Arrivals by trajectory, in their order; of each the newest, and bounded in bytes all told."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._held: dict[str, deque[Arrival]] = {}

    def __contains__(self, name: object) -> bool:
        return name in self._held

    @property
    def bytes(self) -> int:
        """Size of all that is held."""
        return self._bytes

    def add(self, name: str, arrival: Arrival) -> int:
        """Hold one more; how many were let go for it, itself perhaps among them."""
        waiting = self._held.setdefault(name, deque())
        waiting.append(arrival)
        self._bytes += len(arrival.data)
        gone = 0
        while waiting and (len(waiting) > _EACH or self._bytes > self._max_bytes):
            self._bytes -= len(waiting.popleft().data)
            gone += 1
        if not waiting:
            del self._held[name]
        return gone

    def release(self, name: str) -> list[Arrival]:
        """All of one trajectory, oldest first; they are held no more."""
        released = list(self._held.pop(name, ()))
        self._bytes -= sum(len(arrival.data) for arrival in released)
        return released
