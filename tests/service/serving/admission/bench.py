"""Turns with a clock of their own, for the tests beside this."""

from __future__ import annotations

from itertools import count

from koop_service.serving.admission.arrivals import Arrival, lane_of
from koop_service.serving.admission.turns import Turns

NOW = 1000.0  # s
BATCH = 64


class Bench:
    """Turns with a clock and tickets of its own."""

    def __init__(self, messages: int = 2048, size: int = 1 << 26) -> None:
        self.known: set[str] | None = None  # None: all of them
        self.turns = Turns(messages, size, lambda n: self.known is None or n in self.known)
        self.now = NOW
        self.tickets = count()

    def put(self, name: str, data: bytes = b"x", kind: str = "frame") -> bool:
        """False, and nothing happens, where it would have to wait outside."""
        told = self.turns.ready_at(self.now)
        if self.turns.is_full(name, len(data)):
            return False
        key = f"koop/{kind}/00/{name}"
        sooner = self.turns.add(Arrival(key, data, next(self.tickets), at=self.now))
        assert sooner or max(self.turns.ready_at(self.now), self.now) >= told, "nobody is woken"
        return True

    def take(self, most: int = BATCH) -> list[str]:
        return [lane_of(arrival.key) for arrival in self.turns.take(most, self.now)]
