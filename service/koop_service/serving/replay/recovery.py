"""All trajectories whose sources keep logs: who catches up, what is asked, what waits meanwhile.

Owned by the pipeline's thread. It decides with `CatchUp`, one for each trajectory; what it wants
asked it hands to `ask`, which never waits, and what comes back is given to it by `attend`.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count

from koop_protocol import (
    Control,
    Frame,
    Limits,
    ProtocolError,
    ReplayReply,
    decode_as,
    replay_key,
)
from koop_service.serving.admission.arrivals import Arrival
from koop_service.serving.admission.news import LogAnswer, LogNews, LogPresence, LogQuestion
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.replay.catchup import Verdict, room_of
from koop_service.serving.replay.holding import Holding
from koop_service.serving.replay.source import LONGEST_PAUSE, PATIENCE, LoggedSource
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory

log = logging.getLogger("koop.replays")

_HELD_BYTES = 32 << 20


@dataclass(frozen=True, slots=True)
class Replay:
    """Messages to be folded in order, and then finished: a log's answer to question `number`.

    Without a reply: live messages for which no log is waited any more.
    """

    source: LoggedSource
    arrivals: list[Arrival]
    number: int | None = None
    reply: ReplayReply | None = None


class Recovery:
    """Decides about every message of a source with a log, live or replayed."""

    def __init__(
        self,
        registry: Registry,
        ask: Callable[[LogQuestion], None],
        metrics: Metrics,
        limits: Limits,
        most: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._registry = registry
        self._ask = ask
        self._metrics = metrics
        self._limits = limits
        self._most = most
        self._clock = clock
        self._sources: dict[str, LoggedSource] = {}
        self._behind: dict[str, LoggedSource] = {}
        self._replays: deque[Replay] = deque()
        self._holding = Holding(_HELD_BYTES)
        self._numbers = count(1)
        self._brake = Brake()

    @property
    def behind(self) -> int:
        """Trajectories that are catching up."""
        return len(self._behind)

    def is_behind(self, name: str) -> bool:
        """Whether the trajectory is catching up."""
        return name in self._behind

    def is_logged(self, name: str) -> bool:
        """Whether the trajectory's source keeps a log."""
        source = self._sources.get(name)
        return source is not None and not source.mute

    @property
    def is_busy(self) -> bool:
        """Whether there is something to take."""
        return bool(self._replays)

    # News

    def attend(self, news: Iterable[LogNews]) -> None:
        """Sources come and go, logs answer; then ask what is due."""
        for item in news:
            if isinstance(item, LogAnswer):
                self._hear(item)
            elif item.here:
                self._welcome(item.trajectory)
            else:
                self._miss(item)
        if self._behind:
            self._ask_all(self._clock())

    def pause(self) -> float:
        """Time until something is due by itself [s]."""
        now = self._clock()
        due = (s.again for s in self._behind.values() if s.asked is None)
        return max(0.0, min(due, default=now + LONGEST_PAUSE) - now)

    def _welcome(self, name: str) -> None:
        source = self._source(name)
        if source is not None:
            source.come()
            self._fall_behind(source)

    def _miss(self, presence: LogPresence) -> None:
        source = self._sources.get(presence.trajectory)
        if source is not None:
            source.here = False
            self._registry.tell_gone(presence.trajectory)

    def _source(self, name: str) -> LoggedSource | None:
        """The source of that name, new where there is room for it."""
        source = self._sources.get(name)
        if source is None and len(self._sources) >= self._most and not self._forget_one():
            if self._brake.admit("room") is not None:
                log.warning("the log of %r is passed over: there are too many", name[:200])
            return None
        return source or self._sources.setdefault(name, LoggedSource(name))

    def _leave(self, source: LoggedSource) -> None:
        """Its log is gone, and its frames do not speak of one: from now on it is as any other."""
        source.asked = None
        del self._sources[source.name]
        self._behind.pop(source.name, None)
        self._metrics.deferred.inc(len(self._holding.release(source.name)))

    def _forget_one(self) -> bool:
        """Forget a source that is gone, the one known longest; whether there was any."""
        gone = (s.name for s in self._sources.values() if not s.here and not self.is_behind(s.name))
        name = next(gone, None)
        return self._sources.pop(name, None) is not None if name is not None else False

    # Questions

    def _ask_all(self, now: float) -> None:
        for source in list(self._behind.values()):
            if source.asked is not None or now < source.again:
                continue
            if source.is_gone(now):
                # Whatever was not folded, its log will have when it comes again.
                self._metrics.deferred.inc(len(self._holding.release(source.name)))
                source.failing_since = None
                del self._behind[source.name]
            elif source.is_hopeless(now):
                self._do_without(source)
            else:
                self._ask_one(source)

    def _ask_one(self, source: LoggedSource) -> None:
        try:
            trajectory = self._registry.find(source.name)
        except ProtocolError as error:  # no room in memory, or its state cannot be read
            self._fail(source, str(error))
            return
        room = max(source.largest, room_of(len(self._behind)))
        # What is too large for us was refused when it came, and would be again.
        query = source.catch_up.question(trajectory, room, self._limits.max_message_bytes)
        source.asked = next(self._numbers)
        self._metrics.replays.inc()
        self._ask(LogQuestion(source.asked, source.name, query))

    def _hear(self, answer: LogAnswer) -> None:
        source = self._sources.get(answer.question.trajectory)
        if source is None or source.asked != answer.question.number:
            return  # an answer to a question that is of no interest any more
        problem, reply = answer.problem, None
        if answer.payload is not None:
            try:
                reply = self._read(source, answer.payload)
            except ProtocolError as error:
                problem = str(error)
        if reply is None:
            self._fail(source, problem, late=answer.late)
            return
        source.answer()
        self._replays.append(Replay(source, self._arrivals(reply), answer.question.number, reply))

    def _read(self, source: LoggedSource, payload: bytes) -> ReplayReply:
        reply = decode_as(ReplayReply, payload, self._limits.for_replays())
        if reply.trajectory != source.name:
            raise ProtocolError("malformed", f"it answered for {reply.trajectory!r}")
        stands_still = not reply.end and reply.position <= (source.catch_up.position or 0)
        if stands_still:
            raise ProtocolError("malformed", "its answer leads no further")
        return reply

    def _arrivals(self, reply: ReplayReply) -> list[Arrival]:
        key, now = replay_key(reply.trajectory), self._clock()
        return [Arrival(key, data, 0, at=now, replayed=True) for data in reply.messages]

    def _fail(self, source: LoggedSource, problem: str, late: bool = True) -> None:
        source.fail(self._clock(), late)
        if self._brake.admit("answer") is not None:
            log.info("the log of %s is asked again: %s", source.name, problem)

    def _do_without(self, source: LoggedSource) -> None:
        """Its live messages are taken as those of a source without a log."""
        if self._brake.admit("mute") is not None:
            log.warning(
                "the log of %s has not answered for %g s; what it may have is done without until "
                "its source starts anew",
                source.name,
                PATIENCE,
            )
        source.mute, source.failing_since = True, None
        del self._behind[source.name]
        self._replays.append(Replay(source, self._holding.release(source.name)))

    # Replays

    def take(self, count: int) -> list[Replay]:
        """Answers to fold now, with about `count` messages."""
        taken: list[Replay] = []
        size = 0
        while self._replays and (not taken or size + len(self._replays[0].arrivals) <= count):
            taken.append(self._replays.popleft())
            size += len(taken[-1].arrivals)
        return taken

    def finish(self, replay: Replay) -> list[Arrival]:
        """After its messages are folded; the live ones that come next."""
        source, reply = replay.source, replay.reply
        if reply is None or source.asked != replay.number:
            return []
        if any(arrival.stalled for arrival in replay.arrivals):
            self._fail(source, "what it gave could not be encoded")
            return []
        self._tell_dropped(source, reply)
        try:
            self._registry.find(source.name)
        except ProtocolError as error:  # so nothing could be folded either
            self._fail(source, str(error))
            return []
        source.asked, source.again = None, 0.0
        source.catch_up.advance(reply)
        if not reply.end:
            return []
        if self._behind.pop(source.name, None) is not None:
            self._metrics.catching_up.observe(self._clock() - source.behind_since)
        return self._holding.release(source.name)

    def _tell_dropped(self, source: LoggedSource, reply: ReplayReply) -> None:
        if reply.dropped > source.dropped:
            log.warning(
                "the log of %s was full: %d messages of it are lost",
                source.name,
                reply.dropped - source.dropped,
            )
        source.dropped = reply.dropped

    # Messages

    def has_come(self, message: Frame | Control) -> bool:
        """Whether a replayed message is folded already."""
        trajectory = self._registry.find(message.trajectory)
        return trajectory is not None and trajectory.knows(message)

    def admits(self, arrival: Arrival, message: Frame | Control) -> bool:
        """Whether to go on with a live message; if not, it is held, or known."""
        is_logged = isinstance(message, Frame) and message.logged
        source = self._sources.get(message.trajectory)
        if source is None and is_logged:
            source = self._source(message.trajectory)
        if source is not None and isinstance(message, Frame) and not (is_logged or source.here):
            self._leave(source)
            source = None
        if source is None or source.mute:
            return True
        trajectory = self._registry.find(message.trajectory)
        return self._obey(source, source.catch_up.at_the_door(message, trajectory), arrival)

    def folds(self, arrival: Arrival, message: Frame | Control, trajectory: Trajectory) -> bool:
        """The same of any message, when all before it in its batch is folded."""
        if arrival.replayed:
            return not trajectory.knows(message)  # another answer brought it too
        source = self._sources.get(message.trajectory)
        if source is None or source.mute:
            return True
        return self._obey(source, source.catch_up.at_the_fold(message, trajectory), arrival)

    def stalls(self, arrival: Arrival, message: Frame | Control) -> bool:
        """A live message cannot be folded at present; whether its source's log has it too."""
        source = self._sources.get(message.trajectory)
        if source is None or source.mute:
            return False
        source.catch_up.start()
        self._hold(source, arrival)
        return True

    def _obey(self, source: LoggedSource, verdict: Verdict, arrival: Arrival) -> bool:
        if verdict is Verdict.hold:
            self._hold(source, arrival)
        return verdict is Verdict.fold

    def _hold(self, source: LoggedSource, arrival: Arrival) -> None:
        self._metrics.deferred.inc(self._holding.add(source.name, arrival))
        source.hold(len(arrival.data), self._clock())
        self._fall_behind(source)

    def _fall_behind(self, source: LoggedSource) -> None:
        if source.name not in self._behind:
            source.behind_since = self._clock()
            self._behind[source.name] = source
