"""What waits of one share of the queue, and the pace that shares keep while others are active.

Whoever waits for a frame in work waits for all of it, and one alone takes twice as long as one more
in a batch. So it matters less how many frames a busy share gets than that they are not in
work just when somebody else's comes: they go with others' frames.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import NamedTuple

from koop_service.serving.admission.arrivals import STRANGERS, Arrival

_PACE = 0.01
"""While others are active, a share gets one frame in this time [s]. ..."""
_CONTROL = 0.001
"""... A control, which is never encoded, takes so much of that [s], and goes with its frame."""
_SAVED = 0.04
"""Where more than one frame waits, the share keeps its pace with frames that go with others', which
costs these little; or, where none come, with all that it may have once so much is saved [s]."""
_SPARED = 0.02
"""Of several that go with others' frames at once, all but the first need so much saved [s]: two
would make them wait longer than one does. So does the first where one of these is late."""
_TOGETHER = 20
"""All strangers together go so many times faster: a thousand trajectories may begin on one link,
which waits as a whole."""
_OTHERS, _AT_MOST = 9.0, 0.3
"""... And after each work for them the others have the processor for so many times as long, up to
so many seconds: a process that was suspended meanwhile keeps nobody out."""
_FEW, _SHORT = 4, 0.0005
"""While others are active, so many strangers are taken at once, or as few as were done in so short
a time [s], where no other is to be taken: who comes meanwhile waits for no more. ..."""
_LONELY = 0.02
"""... Where even one took longer, or somebody waits for an answer, they go with others' frames; by
themselves where none of these come for so long [s]. An answer is sent by another thread, which gets
the interpreter only after them."""
_ACTIVE = 1.0
"""How long after its last measurement a share still counts as active [s]."""


@dataclass(slots=True)
class Share:
    """What waits of one share: `queue` in order of arrival, with what was taken out of turn.

    messages, frames, size [bytes]: of what was not taken.
    """

    queue: deque[Arrival] = field(default_factory=deque)
    messages: int = 0
    frames: int = 0
    size: int = 0

    def add(self, arrival: Arrival) -> None:
        """At the end."""
        self.queue.append(arrival)
        self._count(arrival, 1)

    def discount(self, arrival: Arrival) -> None:
        """It takes no room any more; its place in the queue may stay."""
        self._count(arrival, -1)

    def give_up(self, arrivals: Collection[Arrival]) -> None:
        """These go elsewhere."""
        for arrival in arrivals:
            self.discount(arrival)
        gone = set(map(id, arrivals))
        self.queue = deque(arrival for arrival in self.queue if id(arrival) not in gone)

    def oldest(self) -> Arrival | None:
        """The oldest that was not taken; those before it are let go."""
        while self.queue and self.queue[0].taken:
            self.queue.popleft()
        return self.queue[0] if self.queue else None

    def _count(self, arrival: Arrival, sign: int) -> None:
        self.messages += sign
        self.frames += sign * arrival.is_frame
        self.size += sign * len(arrival.data)


class Company(NamedTuple):
    """Who is in a batch already: so many of a share's own, so many others, and whether one of
    those had to wait."""

    mine: int
    others: int
    late: bool

    @property
    def costs(self) -> float:
        """What a share with a backlog must have saved [s] for one more frame among these."""
        if not self.mine + self.others:
            return _SAVED
        return _SPARED if self.others and (self.mine or self.late) else 0.0


ALONE = Company(0, 0, False)


@dataclass(slots=True)
class _Activity:
    """When a share last got something, and until when it has used up its pace [s]."""

    at: float = 0.0
    paid: float = 0.0


class Paces:
    """Who is active, and when each may have its next measurement. Times [s] are by one clock."""

    def __init__(self) -> None:
        self._active: OrderedDict[str, _Activity] = OrderedDict()  # least active first
        self._kept = True
        self._stranger = 0.0  # time that the last ones took, each [s]

    @property
    def few(self) -> int:
        """Strangers that may be taken at once, by themselves, while others are active."""
        return _FEW if self._stranger * _FEW <= _SHORT else int(_SHORT / self._stranger)

    def patience(self, asked: bool) -> float:
        """How long they wait for company [s]; `asked`: somebody waits for an answer."""
        return 0.0 if self.few and not asked else _LONELY

    def note(self, name: str, at: float) -> None:
        """The share got something."""
        self._active.setdefault(name, _Activity()).at = at
        self._active.move_to_end(name)

    def end(self) -> None:
        """From now on nobody keeps a pace."""
        self._kept = False

    def are_kept(self, now: float) -> bool:
        """Whether more than one share is active, so that each keeps its pace."""
        while self._active and next(iter(self._active.values())).at < now - _ACTIVE:
            self._active.popitem(last=False)
        return self._kept and len(self._active) > 1

    def turn_of(self, name: str, share: Share, company: Company = ALONE) -> float:
        """When the share may have its next measurement, in a batch with these."""
        activity, following = self._active.get(name), share.oldest()
        if activity is None or following is None:
            return 0.0
        if name == STRANGERS:
            return max(activity.paid, following.at)
        if not following.is_frame:
            return activity.paid - _PACE
        return activity.paid + (company.costs if share.frames > 1 else 0.0)

    def has_saved(self, name: str, now: float) -> bool:
        """Whether the share, not the strangers', has used so little that it may save no more."""
        activity = self._active.get(name)
        return activity is not None and name != STRANGERS and activity.paid + _SAVED <= now

    def pay(self, arrival: Arrival, now: float) -> None:
        """The share has had this one."""
        activity = self._active.get(arrival.share)
        if activity is None:
            return
        cost, since = _PACE if arrival.is_frame else _CONTROL, now - _SAVED
        if arrival.share == STRANGERS:
            cost, since = cost / _TOGETHER, now  # who saves could flood all at once
        activity.paid = max(activity.paid, since) + cost

    def pay_work(self, count: int, seconds: float, now: float) -> None:
        """So many strangers have had so much of the processor's time [s]: new trajectories cost it
        far more than messages that are refused."""
        self._stranger = seconds / count
        activity = self._active.get(STRANGERS)
        if activity is not None:
            activity.paid = max(activity.paid, now + min(_OTHERS * seconds, _AT_MOST))
