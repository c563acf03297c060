"""Measurements that wait, and whose turn it is: in order within a trajectory, fair between them.

Every trajectory is a *lane*, and has a *share* of the queue of its own; all that come under names
that nobody knows have one share together. A share has a bounded part of the room, and the shares
take turns, and while others are active each at a pace that is far above any camera's. So a source
that floods holds itself back; a measurement of another one waits for nobody's backlog, and finds
the processor free.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from koop_protocol import ProtocolError

_NEVER = float("inf")
_CONTROLS = "koop/control/"
_STRANGERS = ""
"""The share of lanes that are not known; no lane has this name."""
_PART = 8
"""A share has at most this part of the room, where that is more than the least."""
_LEAST_MESSAGES, _LEAST_SIZE = 64, 1 << 20
_PACE = 0.01
"""While others are active, a share gets one frame in this time [s], and never two at once: others
wait for what is in work. ..."""
_CONTROL = 0.001
"""... A control, which is never encoded, takes so much of that [s], and goes with its frame."""
_TOGETHER = 20
"""All strangers together go so many times faster: a thousand trajectories may begin on one link,
which waits as a whole."""
_ACTIVE = 1.0
"""How long after its last measurement a share still counts as active [s]."""


@dataclass(slots=True)
class Arrival:
    """One measurement's bytes as they came, or what was wrong with them before they were read.

    `share` is whose room it takes; `taken` marks what a short cut took out of turn. `at` is when it
    came, by time.monotonic [s]. `replayed`: it came out of a source's log, not from the queue.
    """

    key: str
    data: bytes
    ticket: int
    fault: ProtocolError | None = None
    taken: bool = False
    at: float = 0.0
    replayed: bool = False
    share: str = _STRANGERS


def lane_of(key: str) -> str:
    """The part of a measurement's key that frames and controls of one trajectory share."""
    parts = key.split("/", 3)
    return parts[3] if len(parts) == 4 else key


@dataclass(slots=True)
class _Share:
    """What waits of one share: `queue` in order of arrival, with what was taken out of turn."""

    queue: deque[Arrival] = field(default_factory=deque)
    messages: int = 0
    size: int = 0


@dataclass(slots=True)
class _Activity:
    """When a share last got something, and until when it has used up its pace [s]."""

    at: float = 0.0
    paid: float = 0.0


class Turns:
    """The waiting measurements. Not for several threads at once.

    max_messages, max_size [bytes]: the room for all. known: whether a lane has a share of its own.
    `now` below is the time by the clock of `Arrival.at` [s].
    """

    def __init__(
        self, max_messages: int, max_size: int, known: Callable[[str], bool] = lambda _: True
    ) -> None:
        self._room = (max_messages, max_size)
        self._part = (
            max(min(max_messages, _LEAST_MESSAGES), max_messages // _PART),
            max(min(max_size, _LEAST_SIZE), max_size // _PART),
        )
        self._known = known
        self._lanes: dict[str, deque[Arrival]] = {}
        self._shares: OrderedDict[str, _Share] = OrderedDict()  # the first one's turn is next
        self._active: OrderedDict[str, _Activity] = OrderedDict()  # least active first
        self._messages = 0
        self._size = 0
        self._paced = True

    def __len__(self) -> int:
        """Measurements waiting."""
        return self._messages

    @property
    def load(self) -> float:
        """How full the room is: from 1 on sources are held back."""
        messages, size = self._room
        return max(self._messages / messages, self._size / size)

    def is_full(self, lane: str, size: int) -> bool:
        """Whether a measurement of `size` bytes must wait outside. One that is alone never must."""
        share = self._shares.get(self._share_of(lane), _Share())
        return _exceeds(self._messages, self._size + size, *self._room) or _exceeds(
            share.messages, share.size + size, *self._part
        )

    def add(self, arrival: Arrival) -> None:
        """Let it wait for its turn."""
        lane, size = lane_of(arrival.key), len(arrival.data)
        arrival.share = name = self._share_of(lane)
        self._lanes.setdefault(lane, deque()).append(arrival)
        share = self._shares.setdefault(name, _Share())
        share.queue.append(arrival)
        share.messages, share.size = share.messages + 1, share.size + size
        self._messages, self._size = self._messages + 1, self._size + size
        self._active.setdefault(name, _Activity()).at = arrival.at
        self._active.move_to_end(name)

    def hurry(self) -> None:
        """From now on nobody keeps a pace: nothing more comes, and all is to be taken."""
        self._paced = False

    def ready_at(self, now: float) -> float:
        """When `take` next gives something; infinity where nothing waits."""
        if not self._is_crowded(now):
            return now if self._messages else _NEVER
        soonest = _NEVER
        for name, share in self._shares.items():
            if share.messages:
                soonest = min(soonest, self._turn_of(name))
                if soonest <= now:
                    break
        return soonest

    def take(self, count: int, now: float) -> list[Arrival]:
        """At most `count`, one of each share after the other's."""
        crowded, batch, before = self._is_crowded(now), [], -1
        while before < len(batch) < count:
            before = len(batch)
            for name in list(self._shares):
                if len(batch) < count and (not crowded or self._turn_of(name) <= now):
                    batch += self._take_one(name, now)
        return batch

    def take_of(self, lane: str, before: int, count: int, now: float) -> list[Arrival]:
        """The oldest of one lane with a ticket below `before`, out of turn."""
        batch: list[Arrival] = []
        most = min(count, 2) if self._is_crowded(now) else count  # a frame and its control
        while len(batch) < most and self.oldest_of(lane) < before:
            arrival = self._remove(lane)
            batch.append(replace(arrival))
            self._pay(arrival, now)
            # Its place in the share stays until its turn; its bytes do not.
            arrival.taken, arrival.data = True, b""
        return batch

    def oldest(self) -> float:
        """The lowest ticket that waits; infinity where none does."""
        return min((waiting[0].ticket for waiting in self._lanes.values()), default=_NEVER)

    def oldest_of(self, lane: str) -> float:
        """The lane's lowest ticket that waits; infinity where none does."""
        waiting = self._lanes.get(lane)
        return waiting[0].ticket if waiting else _NEVER

    def _share_of(self, lane: str) -> str:
        waiting = self._lanes.get(lane)
        if waiting and waiting[-1].share != _STRANGERS:
            return waiting[-1].share
        if not self._known(lane):
            return _STRANGERS
        if waiting:
            self._settle(lane, waiting)
        return lane

    def _settle(self, lane: str, waiting: deque[Arrival]) -> None:
        """What waits of a lane that has become known goes on in a share of its own.

        Left with the strangers, it would keep their one pace as long as some of it waits there: for
        ever, where several sources begin at once.
        """
        strangers, own = self._shares[_STRANGERS], self._shares.setdefault(lane, _Share())
        strangers.queue = deque(a for a in strangers.queue if a.taken or lane_of(a.key) != lane)
        for arrival in waiting:
            arrival.share = lane
            own.queue.append(arrival)
        size = sum(len(arrival.data) for arrival in waiting)
        strangers.messages -= len(waiting)
        strangers.size -= size
        own.messages += len(waiting)
        own.size += size

    def _take_one(self, name: str, now: float) -> list[Arrival]:
        """The share's oldest, if it still has one; then it is at the end of the line."""
        queue = self._shares[name].queue
        while queue and queue[0].taken:
            queue.popleft()
        found = [self._remove(lane_of(queue.popleft().key))] if queue else []
        for arrival in found:
            self._pay(arrival, now)
        if queue:
            self._shares.move_to_end(name)
        else:
            del self._shares[name]
        return found

    def _remove(self, lane: str) -> Arrival:
        """The lane's oldest; where the share's order leads to it, it is the share's oldest too."""
        waiting = self._lanes[lane]
        arrival = waiting.popleft()
        if not waiting:
            del self._lanes[lane]
        share, size = self._shares[arrival.share], len(arrival.data)
        share.messages, share.size = share.messages - 1, share.size - size
        self._messages, self._size = self._messages - 1, self._size - size
        return arrival

    def _is_crowded(self, now: float) -> bool:
        """Whether more than one share is active, so that each keeps its pace."""
        while self._active and next(iter(self._active.values())).at < now - _ACTIVE:
            self._active.popitem(last=False)
        return self._paced and len(self._active) > 1

    def _turn_of(self, name: str) -> float:
        """When the share may have its next measurement."""
        activity = self._active.get(name)
        if activity is None:
            return 0.0
        following = next((a for a in self._shares[name].queue if not a.taken), None)
        alone = name != _STRANGERS and (following is None or _is_frame(following))
        return activity.paid - (0.0 if alone else _PACE)

    def _pay(self, arrival: Arrival, now: float) -> None:
        activity = self._active.get(arrival.share)
        if activity:
            cost = _PACE if _is_frame(arrival) else _CONTROL
            if arrival.share == _STRANGERS:
                cost /= _TOGETHER
            activity.paid = max(activity.paid, now) + cost


def _is_frame(arrival: Arrival) -> bool:
    """By its key; what is neither frame nor control counts as one."""
    return not arrival.key.startswith(_CONTROLS)


def _exceeds(messages: int, size: int, max_messages: int, max_size: int) -> bool:
    return messages > 0 and (messages >= max_messages or size > max_size)
