"""Measurements that wait, and whose turn it is: in order within a trajectory, fair between them.

Every trajectory is a *lane*, and has a *share* of the queue of its own; all that come under names
that nobody knows have one share together. A share has a bounded part of the room, and the shares
take turns, and while others are active each at a pace that is far above any camera's. So a source
that floods holds itself back; a measurement of another one waits for nobody's backlog, and finds
the processor free. Strangers get what time the known ones leave, or go with their frames.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from koop_service.serving.admission.arrivals import STRANGERS, Arrival, lane_of
from koop_service.serving.admission.shares import Company, Paces, Share

_NEVER = float("inf")
_COMPANY = 4
"""One stranger goes with the known ones' frames, or with so many of these one each."""
_LATE = 0.0005
"""... But with a few of which one has waited so long [s] for others only where the strangers have
waited too, and nobody's backlog either: it would be later still."""
_PART = 8
"""A share has at most this part of the room, where that is more than the least."""
_LEAST_MESSAGES, _LEAST_SIZE = 64, 1 << 20


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
        self._shares: OrderedDict[str, Share] = OrderedDict()  # the first one's turn is next
        self._paces = Paces()
        self._settled = False  # some lane has, since the last `add`
        self._messages = 0
        self._size = 0

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
        share = self._shares.get(self._share_of(lane), Share())
        return _exceeds(self._messages, self._size + size, *self._room) or _exceeds(
            share.messages, share.size + size, *self._part
        )

    def add(self, arrival: Arrival) -> bool:
        """Let it wait for its turn; whether that may come before the time that `ready_at` told.

        It cannot where others of its share wait: their turn comes first.
        """
        lane, size = lane_of(arrival.key), len(arrival.data)
        arrival.share = self._share_of(lane)
        self._lanes.setdefault(lane, deque()).append(arrival)
        share = self._shares.setdefault(arrival.share, Share())
        share.add(arrival)
        self._messages, self._size = self._messages + 1, self._size + size
        self._paces.note(arrival.share, arrival.at)
        sooner, self._settled = self._settled or share.messages == 1, False
        return sooner

    def hurry(self) -> None:
        """From now on nobody keeps a pace: nothing more comes, and all is to be taken."""
        self._paces.end()

    def ready_at(self, now: float, asked: bool = False) -> float:
        """When `take` next gives something; infinity where nothing waits.

        asked: somebody waits for an answer.
        """
        if not self._paces.are_kept(now):
            return now if self._messages else _NEVER
        soonest = _NEVER
        for name, share in self._shares.items():
            if share.messages:
                patience = self._paces.patience(asked) if name == STRANGERS else 0.0
                soonest = min(soonest, self._paces.turn_of(name, share) + patience)
                if soonest <= now:
                    break
        return soonest

    def take(self, count: int, now: float, asked: bool = False) -> list[Arrival]:
        """At most `count`, one of each share after the other's, and the strangers with them."""
        if not self._paces.are_kept(now):
            return self._take_round(count, now, lambda *_: True)
        batch = self._take_round(count, now, self._may)
        if any(arrival.is_frame for arrival in batch):
            patience = self._paces.patience(asked=True) if _is_late(batch, now) else 0.0
            return batch + self._take_strangers(max(1, len(batch) // _COMPANY), patience, now)
        few, patience = max(1, self._paces.few), self._paces.patience(asked)
        return batch or self._take_strangers(few, patience, now)

    def take_of(self, lane: str, before: int, count: int, now: float) -> list[Arrival]:
        """The oldest of one lane with a ticket below `before`, out of turn.

        While a pace is kept that is a frame and its control, or all of a share that has saved what
        it may: its backlog is not its fault, but comes from too much in all.
        """
        batch: list[Arrival] = []
        least = self._paces.are_kept(now) and not self._paces.has_saved(self._share_of(lane), now)
        most = min(count, 2) if least else count
        while len(batch) < most and self.oldest_of(lane) < before:
            arrival = self._remove(lane)
            batch.append(replace(arrival))
            self._paces.pay(arrival, now)
            # Its place in the share stays until its turn; its bytes do not.
            arrival.taken, arrival.data = True, b""
        return batch

    def worked(self, batch: Sequence[Arrival], seconds: float, now: float) -> None:
        """What `take` gave has taken so long [s]; strangers pay for their part of that.

        Among others' frames that is the part of those that are known now: a trajectory was opened
        for them. The rest were refused, which costs next to nothing.
        """
        strangers = [lane_of(arrival.key) for arrival in batch if arrival.share == STRANGERS]
        others = len(batch) - len(strangers)
        if others:
            opened = sum(map(self._known, strangers))
            seconds *= opened / (others + opened)
        if strangers:
            self._paces.pay_work(len(strangers), seconds, now)

    def oldest(self) -> float:
        """The lowest ticket that waits; infinity where none does."""
        return min((waiting[0].ticket for waiting in self._lanes.values()), default=_NEVER)

    def oldest_of(self, lane: str) -> float:
        """The lane's lowest ticket that waits; infinity where none does."""
        waiting = self._lanes.get(lane)
        return waiting[0].ticket if waiting else _NEVER

    def _share_of(self, lane: str) -> str:
        waiting = self._lanes.get(lane)
        if waiting and waiting[-1].share != STRANGERS:
            return waiting[-1].share
        if not self._known(lane):
            return STRANGERS
        if waiting:
            self._settle(lane, waiting)
        return lane

    def _settle(self, lane: str, waiting: deque[Arrival]) -> None:
        """What waits of a lane that has become known goes on in a share of its own.

        Left with the strangers, it would keep their one pace as long as some of it waits there: for
        ever, where several sources begin at once.
        """
        self._settled = True
        strangers, own = self._shares[STRANGERS], self._shares.setdefault(lane, Share())
        strangers.give_up(waiting)
        for arrival in waiting:
            arrival.share = lane
            own.add(arrival)

    def _take_round(
        self, count: int, now: float, may: Callable[[str, int, list[Arrival], float], bool]
    ) -> list[Arrival]:
        """One of each share that `may`, as long as there are any.

        It is told the batch so far, and how many of it are the share's own.
        """
        batch: list[Arrival] = []
        taken: Counter[str] = Counter()
        before = -1
        while before < len(batch) < count:
            before = len(batch)
            for name in list(self._shares):
                if len(batch) < count and may(name, taken[name], batch, now):
                    found = self._take_one(name, now)
                    taken[name] += len(found)
                    batch += found
        return batch

    def _may(self, name: str, mine: int, batch: list[Arrival], now: float) -> bool:
        """Whether it is the turn of a share that keeps its pace, and not the strangers'."""
        if name == STRANGERS:
            return False
        company = Company(mine, len(batch) - mine, _is_late(batch, now, but=name))
        return self._paces.turn_of(name, self._shares[name], company) <= now

    def _take_strangers(self, count: int, patience: float, now: float) -> list[Arrival]:
        """So many of them, if their turn came so long [s] ago."""
        batch: list[Arrival] = []
        share = self._shares.get(STRANGERS)
        if share is None or not share.messages:
            return batch
        if self._paces.turn_of(STRANGERS, share) + patience <= now:
            while len(batch) < count and STRANGERS in self._shares:
                batch += self._take_one(STRANGERS, now)
        return batch

    def _take_one(self, name: str, now: float) -> list[Arrival]:
        """The share's oldest, if it still has one; then it is at the end of the line."""
        share = self._shares[name]
        arrival = share.oldest()
        if arrival is not None:
            share.queue.popleft()
            self._remove(lane_of(arrival.key))
            self._paces.pay(arrival, now)
        if share.queue:
            self._shares.move_to_end(name)
        else:
            del self._shares[name]
        return [] if arrival is None else [arrival]

    def _remove(self, lane: str) -> Arrival:
        """The lane's oldest; where the share's order leads to it, it is the share's oldest too."""
        waiting = self._lanes[lane]
        arrival = waiting.popleft()
        if not waiting:
            del self._lanes[lane]
        self._shares[arrival.share].discount(arrival)
        self._messages, self._size = self._messages - 1, self._size - len(arrival.data)
        return arrival


def _is_late(batch: list[Arrival], now: float, but: str = STRANGERS) -> bool:
    """Whether these are few, and one of another share than `but` has waited already."""
    return len(batch) < _COMPANY and any(
        arrival.share != but and now - arrival.at > _LATE for arrival in batch
    )


def _exceeds(messages: int, size: int, max_messages: int, max_size: int) -> bool:
    return messages > 0 and (messages >= max_messages or size > max_size)
