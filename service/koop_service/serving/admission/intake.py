"""The queues between Zenoh's threads and the pipeline: bounded and counted.

Every arrival, measurement or query, takes a ticket from one counter. That makes "after everything
that arrived before me" a comparison of numbers: a query about one trajectory is answered once no
measurement of that trajectory with a lower ticket is waiting, and it need not wait for anybody
else's. `take_of` is the short cut that serves such measurements first.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from koop_protocol import ProtocolError
from koop_service.serving.admission.arrivals import Arrival, lane_of
from koop_service.serving.admission.news import LogNews, Presence
from koop_service.serving.admission.turns import Turns

Q = TypeVar("Q")


@dataclass(frozen=True, slots=True)
class Waiting(Generic[Q]):
    """One query and its ticket."""

    query: Q
    ticket: int


class Intake(Generic[Q]):
    """Measurements, queries and news of sources' logs on their way to the pipeline.

    `put` blocks while the queue is full, or the part of it that one source may fill: it runs on the
    source's own link, so that the source is held back (what Zenoh's BLOCK means) and nothing is
    dropped. `ask` never blocks: an overloaded service says so. Each kind of query has bounds of its
    own, so that a flood of one leaves room for the others.
    """

    def __init__(
        self,
        max_messages: int,
        max_bytes: int,
        max_queries: int,
        held: Callable[[], None] = lambda: None,
        known: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._max_bytes = max_bytes
        self._max_queries = max_queries
        self._held = held
        self._lock = threading.Lock()
        self._work = threading.Condition(self._lock)
        self._space = threading.Condition(self._lock)
        self._turns = Turns(max_messages, max_bytes, known)
        self._queries: deque[Waiting[Q]] = deque()
        self._presences: deque[Presence] = deque()
        self._news: deque[LogNews] = deque()
        self._unanswered: Counter[str] = Counter()
        self._query_bytes: Counter[str] = Counter()
        self._tickets = 0
        self._closed = False

    @property
    def depth(self) -> int:
        """Measurements waiting."""
        return len(self._turns)

    @property
    def unanswered(self) -> int:
        """Queries taken in and not answered yet."""
        return self._unanswered.total()

    @property
    def load(self) -> float:
        """How full the queue of measurements is: from 1 on sources are held back."""
        return self._turns.load

    def put(self, key: str, data: bytes, fault: ProtocolError | None = None) -> bool:
        """Add a measurement, waiting for space; False if the queue was closed instead."""
        now, lane, size = time.monotonic(), lane_of(key), len(data)
        with self._lock:
            if self._turns.is_full(lane, size):
                self._held()
                self._space.wait_for(lambda: self._closed or not self._turns.is_full(lane, size))
            if self._closed:
                return False
            arrival = Arrival(key, data, self._next_ticket(), fault, at=now)
            if self._turns.add(arrival):  # else nobody is woken in vain, here neither
                self._work.notify()
        return True

    def ask(self, query: Q, size: int = 0, kind: str = "") -> bool:
        """Add a query of `size` bytes; False if too many of its kind wait, or too large ones."""
        with self._lock:
            too_many = self._unanswered[kind] >= self._max_queries
            if self._closed or too_many or self._query_bytes[kind] + size > self._max_bytes:
                return False
            self._unanswered[kind] += 1
            self._query_bytes[kind] += size
            self._queries.append(Waiting(query, self._next_ticket()))
            self._work.notify()
        return True

    def answered(self, size: int = 0, kind: str = "") -> None:
        """Make room for another query, after one of `size` bytes of this kind."""
        with self._lock:
            self._unanswered[kind] -= 1
            self._query_bytes[kind] -= size
            if len(self._turns) and not self.unanswered:
                self._work.notify()

    def notice(self, presence: Presence) -> None:
        """Add that an owner came or went; never blocks, and is never refused."""
        with self._lock:
            self._presences.append(presence)
            self._work.notify()

    def tell(self, news: LogNews) -> None:
        """Add news of a source's log; never blocks, and is never refused."""
        with self._lock:
            self._news.append(news)
            self._work.notify()

    def wait(self, timeout: float) -> None:
        """Until something can be done, the queues are closed, or `timeout` [s] has passed."""
        now = time.monotonic()
        deadline = now + timeout
        with self._lock:
            while not self._has_work(now) and now < deadline:
                self._work.wait(min(deadline, self._ready_at(now)) - now)
                now = time.monotonic()

    def take(self, count: int) -> list[Arrival]:
        """Measurements in turn, at most `count`."""
        with self._lock:
            return self._taken(self._turns.take(count, time.monotonic(), self.unanswered > 0))

    def worked(self, batch: list[Arrival], seconds: float) -> None:
        """Say how long [s] what `take` gave has taken; strangers wait accordingly."""
        with self._lock:
            self._turns.worked(batch, seconds, time.monotonic())

    def take_of(self, lane: str, before: int, count: int) -> list[Arrival]:
        """The oldest measurements of one trajectory with a ticket below `before`, out of turn."""
        with self._lock:
            return self._taken(self._turns.take_of(lane, before, count, time.monotonic()))

    def take_queries(self) -> list[Waiting[Q]]:
        """All queries that came since the last call, oldest first."""
        with self._lock:
            queries = list(self._queries)
            self._queries.clear()
            return queries

    def take_presences(self) -> list[Presence]:
        """Who came and went since the last call, in order."""
        with self._lock:
            presences = list(self._presences)
            self._presences.clear()
            return presences

    def take_news(self) -> list[LogNews]:
        """News of sources' logs since the last call, in order."""
        with self._lock:
            news = list(self._news)
            self._news.clear()
            return news

    def is_behind(self, ticket: int, lane: str | None) -> bool:
        """Whether a measurement of this trajectory (None: of any) older than `ticket` waits."""
        with self._lock:
            turns = self._turns
            return (turns.oldest() if lane is None else turns.oldest_of(lane)) < ticket

    def close(self) -> None:
        """Take nothing more in, and let everybody go who waits here."""
        with self._lock:
            self._closed = True
            self._turns.hurry()
            self._work.notify_all()
            self._space.notify_all()

    def _taken(self, batch: list[Arrival]) -> list[Arrival]:
        if batch:  # else nobody is woken in vain, to compete with the pipeline's thread
            self._space.notify_all()
        return batch

    def _has_work(self, now: float) -> bool:
        others = (self._queries, self._presences, self._news)
        return self._closed or any(others) or self._ready_at(now) <= now

    def _ready_at(self, now: float) -> float:
        return self._turns.ready_at(now, self.unanswered > 0)

    def _next_ticket(self) -> int:
        self._tickets += 1
        return self._tickets
