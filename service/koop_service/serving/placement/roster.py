"""Who is which worker, whom to start, and when: the supervisor's decisions, without its processes.

A member is a process of whatever kind. It loads, is prepared, is given a seat (the number of the
worker it is to be), and dies at some time. One that is prepared while all seats are taken is a
spare: it takes the first seat that falls vacant, at once. Members that die soon after another make
the next start wait longer each time.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Generic, TypeVar

M = TypeVar("M", bound=Hashable)

_FIRST_WAIT, _LONGEST_WAIT = 0.5, 10.0
"""Seconds from the second death in a row to the start of a successor, and at most."""
_LIVED = 30.0
"""Whoever lived that long [s] after the former death makes it a new beginning."""


class Roster(Generic[M]):
    """`seats` workers and `spares` members that wait."""

    def __init__(self, seats: int, spares: int) -> None:
        self._seats, self._spares = seats, spares
        self._vacant = list(range(seats))
        self._loading: set[M] = set()
        self._waiting: list[M] = []
        self._seated: dict[M, int] = {}
        self._deaths = 0
        self._last_death = float("-inf")
        self._not_before = float("-inf")

    def to_start(self, now: float) -> int:
        """How many members to start now."""
        return max(0, self._missing) if now >= self._not_before else 0

    def wake(self) -> float | None:
        """When to ask `to_start` again, if nothing happens before; None: not at all."""
        return self._not_before if self._missing > 0 else None

    def started(self, member: M) -> None:
        """A new member loads."""
        self._loading.add(member)

    def prepared(self, member: M) -> None:
        """It has loaded everything."""
        self._loading.discard(member)
        self._waiting.append(member)

    def seat(self) -> list[tuple[M, int]]:
        """Who is to take which seat now."""
        pairs = []
        while self._vacant and self._waiting:
            member, number = self._waiting.pop(0), self._vacant.pop(0)
            self._seated[member] = number
            pairs.append((member, number))
        return pairs

    def died(self, member: M, now: float) -> int | None:
        """It is gone; the seat that it leaves vacant, None if it had none."""
        self._loading.discard(member)
        if member in self._waiting:
            self._waiting.remove(member)
        self._deaths = 1 if now - self._last_death > _LIVED else self._deaths + 1
        self._last_death = now
        if self._deaths > 1:
            wait = _FIRST_WAIT * 2.0 ** min(self._deaths - 2, 10)
            self._not_before = now + min(wait, _LONGEST_WAIT)
        number = self._seated.pop(member, None)
        if number is not None:
            self._vacant = sorted([*self._vacant, number])
        return number

    @property
    def _missing(self) -> int:
        """Workers first: a spare is only started once every seat is taken."""
        wanted = self._seats + (0 if self._vacant else self._spares)
        return wanted - len(self._loading) - len(self._waiting) - len(self._seated)
