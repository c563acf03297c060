"""When to trust a live stream, and when to ask its source's log first: one trajectory's decisions.

A source with a log writes before it puts. So whatever is missing can be had, and nothing needs to
be given up, as long as the fold takes messages without a gap: those of the log first, then the live
ones from where the log ended. What is given up is only what the log was seen not to have.

Values only: no clock, no thread, no network.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from koop_protocol import Control, Frame, ReplayQuery, ReplayReply
from koop_service.serving.trajectories.trajectory import Trajectory

ANSWERS = 16 << 20
"""Of all answers that logs are asked for at once [bytes]."""
_LEAST, _MOST = 1 << 15, 1 << 18
"""Of one answer: 8 and 64 messages of 4 KB, as many as fit into one [bytes]."""


def room_of(behind: int) -> int:
    """Bytes to ask each log for where so many trajectories are behind.

    An answer comes behind all that its source's link holds. So many are asked at once, for a little
    each; few, for much.
    """
    return min(max(ANSWERS // max(1, behind), _LEAST), _MOST)


class Verdict(StrEnum):
    """What to do with a live message.

    fold: take it, as any source's. known: pass it over, the fold has it. hold: it comes too early;
    the log has it too.
    """

    fold = "fold"
    known = "known"
    hold = "hold"


@dataclass(frozen=True, slots=True)
class Place:
    """A number in an epoch."""

    epoch: str
    seq: int


@dataclass(slots=True)
class CatchUp:
    """How one trajectory stands to its source's log.

    following: live messages continue what is folded; otherwise the log is asked first.
    position: where in the log to go on asking; None: from what the fold needs.
    seen: the newest message of the log when it was last read to its end.
    doubt: the message that last made us ask. Where it comes back after that, the log has no more to
    say about it than it said.
    """

    following: bool = False
    position: int | None = None
    seen: Place | None = None
    doubt: Place | None = None

    def start(self) -> None:
        """From now on the log is asked first, and nothing is known of it."""
        self.following, self.position, self.seen, self.doubt = False, None, None, None

    def at_the_door(self, message: Frame | Control, trajectory: Trajectory | None) -> Verdict:
        """Before a live message is encoded. A `hold` where live ones were followed starts anew."""
        if not self.following:
            return Verdict.hold
        if trajectory is not None:
            if trajectory.knows(message):
                return Verdict.known
            if trajectory.epoch == message.epoch:
                return Verdict.fold
        # Where the log was read into this epoch, the service does not take what is in it.
        if not _has_log(message) or message.epoch in (_epoch(self.seen), _epoch(self.doubt)):
            return Verdict.fold
        return self._hold(Place(message.epoch, message.seq))

    def at_the_fold(self, message: Frame | Control, trajectory: Trajectory) -> Verdict:
        """When all before it in the batch is folded."""
        if trajectory.knows(message):
            return Verdict.known
        if not self.following:  # since a message before it in this batch was held
            return Verdict.hold
        if isinstance(message, Control) or message.epoch != trajectory.stream.epoch:
            return Verdict.fold
        lacked = trajectory.stream.lacks(message.seq)
        if lacked is None or not message.logged:
            return Verdict.fold
        before = Place(message.epoch, lacked)
        return Verdict.fold if self._log_lacks(before) else self._hold(before)

    def question(self, trajectory: Trajectory | None, room: int, largest: int) -> ReplayQuery:
        """What to ask the log now; for `room` bytes of messages, each of at most `largest`."""
        if self.position is not None:
            return ReplayQuery(None, 0, self.position, room, largest)
        if trajectory is None or trajectory.stream.epoch is None:
            return ReplayQuery(None, 0, None, room, largest)
        stream = trajectory.stream
        return ReplayQuery(stream.epoch, stream.replay_from, None, room, largest)

    def advance(self, reply: ReplayReply) -> None:
        """All messages of the reply were given to the fold."""
        self.position = reply.position
        if reply.end:
            self.following, self.position = True, None
            if reply.last_epoch is not None and reply.last_seq is not None:
                self.seen = Place(reply.last_epoch, reply.last_seq)

    def _hold(self, doubt: Place) -> Verdict:
        self.following, self.position, self.doubt = False, None, doubt
        return Verdict.hold

    def _log_lacks(self, frame: Place) -> bool:
        """Whether the log has nothing before this frame that it has not given."""
        if self.doubt == frame:
            return True
        return (
            self.seen is not None and self.seen.epoch == frame.epoch and self.seen.seq >= frame.seq
        )


def _has_log(message: Frame | Control) -> bool:
    """Whether the message may be in a log; a frame says so."""
    return isinstance(message, Control) or message.logged


def _epoch(place: Place | None) -> str | None:
    return None if place is None else place.epoch
