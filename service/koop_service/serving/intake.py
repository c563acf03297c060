"""The queues between Zenoh's threads and the pipeline: bounded, counted, in order of arrival.

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
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from koop_protocol import ProtocolError
from koop_service.serving.durability.news import LogNews

Q = TypeVar("Q")


@dataclass(slots=True)
class Arrival:
    """One measurement's bytes as they came, or what was wrong with them before they were read.

    `taken` marks what a short cut took out of turn. `at` is when it came, by time.monotonic [s].
    `replayed`: it came out of a source's log, not from the queue.
    """

    key: str
    data: bytes
    ticket: int
    fault: ProtocolError | None = None
    taken: bool = False
    at: float = 0.0
    replayed: bool = False


@dataclass(frozen=True, slots=True)
class Waiting(Generic[Q]):
    """One query and its ticket."""

    query: Q
    ticket: int


@dataclass(frozen=True, slots=True)
class Presence:
    """An owner of tasks came (`here`) or went."""

    owner: str
    here: bool


def lane_of(key: str) -> str:
    """The part of a measurement's key that frames and controls of one trajectory share."""
    parts = key.split("/", 3)
    return parts[3] if len(parts) == 4 else key


class Intake(Generic[Q]):
    """Measurements, queries and news of sources' logs on their way to the pipeline.

    `put` blocks while the queue is full: it runs on the source's own link, so that the source is
    held back (what Zenoh's BLOCK means) and nothing is dropped. `ask` never blocks: an overloaded
    service says so. Each kind of query has bounds of its own, so that a flood of one leaves room
    for the others.
    """

    def __init__(
        self,
        max_messages: int,
        max_bytes: int,
        max_queries: int,
        held: Callable[[], None] = lambda: None,
    ) -> None:
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._max_queries = max_queries
        self._held = held
        self._lock = threading.Lock()
        self._work = threading.Condition(self._lock)
        self._space = threading.Condition(self._lock)
        self._order: deque[Arrival] = deque()
        self._lanes: dict[str, deque[Arrival]] = {}
        self._queries: deque[Waiting[Q]] = deque()
        self._presences: deque[Presence] = deque()
        self._news: deque[LogNews] = deque()
        self._unanswered: Counter[str] = Counter()
        self._query_bytes: Counter[str] = Counter()
        self._messages = 0
        self._bytes = 0
        self._tickets = 0
        self._closed = False

    @property
    def depth(self) -> int:
        """Measurements waiting."""
        return self._messages

    @property
    def unanswered(self) -> int:
        """Queries taken in and not answered yet."""
        return self._unanswered.total()

    @property
    def load(self) -> float:
        """How full the queue of measurements is: from 1 on sources are held back."""
        return max(self._messages / self._max_messages, self._bytes / self._max_bytes)

    def put(self, key: str, data: bytes, fault: ProtocolError | None = None) -> bool:
        """Add a measurement, waiting for space; False if the queue was closed instead."""
        now = time.monotonic()
        with self._lock:
            if self._full(len(data)):
                self._held()
                self._space.wait_for(lambda: self._closed or not self._full(len(data)))
            if self._closed:
                return False
            self._add(Arrival(key, data, self._next_ticket(), fault, at=now))
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
        """Until something is there, the queues are closed, or `timeout` [s] has passed."""
        with self._lock:
            self._work.wait_for(self._has_work, timeout)

    def take(self, count: int) -> list[Arrival]:
        """The oldest measurements, at most `count`."""
        with self._lock:
            batch: list[Arrival] = []
            while self._order and len(batch) < count:
                arrival = self._order.popleft()
                if not arrival.taken:
                    batch.append(self._remove(lane_of(arrival.key)))
            self._space.notify_all()
            return batch

    def take_of(self, lane: str, before: int, count: int) -> list[Arrival]:
        """The oldest measurements of one trajectory with a ticket below `before`, out of turn."""
        with self._lock:
            batch: list[Arrival] = []
            while len(batch) < count and self._oldest_of(lane) < before:
                arrival = self._remove(lane)
                batch.append(replace(arrival))
                # Its place in the order stays until its turn; its bytes do not.
                arrival.taken, arrival.data = True, b""
            self._space.notify_all()
            return batch

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
            return (self._oldest() if lane is None else self._oldest_of(lane)) < ticket

    def close(self) -> None:
        """Take nothing more in, and let everybody go who waits here."""
        with self._lock:
            self._closed = True
            self._work.notify_all()
            self._space.notify_all()

    def _has_work(self) -> bool:
        queues = (self._queries, self._presences, self._news)
        return bool(any(queues) or self._messages or self._closed)

    def _full(self, size: int) -> bool:
        if self._messages == 0:
            return False
        return self._messages >= self._max_messages or self._bytes + size > self._max_bytes

    def _add(self, arrival: Arrival) -> None:
        self._order.append(arrival)
        self._lanes.setdefault(lane_of(arrival.key), deque()).append(arrival)
        self._messages += 1
        self._bytes += len(arrival.data)

    def _remove(self, lane: str) -> Arrival:
        """The lane's oldest; where the global order leads to it, it is the order's oldest too."""
        waiting = self._lanes[lane]
        arrival = waiting.popleft()
        if not waiting:
            del self._lanes[lane]
        self._messages -= 1
        self._bytes -= len(arrival.data)
        return arrival

    def _oldest(self) -> float:
        while self._order and self._order[0].taken:
            self._order.popleft()
        return self._order[0].ticket if self._order else float("inf")

    def _oldest_of(self, lane: str) -> float:
        waiting = self._lanes.get(lane)
        return waiting[0].ticket if waiting else float("inf")

    def _next_ticket(self) -> int:
        self._tickets += 1
        return self._tickets
