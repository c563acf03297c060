"""Past measurements: asking a source's log for them, and telling it what need not be kept."""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field

from koop_protocol import checks
from koop_protocol.errors import ErrorCode, ProtocolError
from koop_protocol.keys import check_trajectory
from koop_protocol.limits import DEFAULT_LIMITS, MAX_ENTRIES, MAX_SEQUENCE, Limits

MAX_BATCH = MAX_ENTRIES
"""Most messages in one reply."""
DEFAULT_BATCH_BYTES = 1 << 20
"""Most bytes of all messages in one reply, unless the query says otherwise."""


@dataclass(frozen=True)
class ReplayQuery:
    """Send what the log has, from here on, in the order in which it was put.

    Attributes:
        epoch: the run that `seq` counts in; None, or a run that the log does not know: from the
            log's beginning.
        seq: lowest number whose frame or control is wanted.
        after: in place of epoch and seq, the ``position`` of the reply before.
        max_bytes: of all messages in the reply together; a single one may be larger.
        max_message_bytes: messages larger than that are passed over; None: none are.
    """

    epoch: str | None = None
    seq: int = 0
    after: int | None = None
    max_bytes: int = DEFAULT_BATCH_BYTES
    max_message_bytes: int | None = None
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        if self.epoch is not None:
            checks.epoch("epoch", self.epoch)
        put(self, "seq", checks.sequence("seq", self.seq))
        if self.after is not None:
            put(self, "after", checks.sequence("after", self.after))
        top = limits.max_message_bytes
        put(self, "max_bytes", checks.integer("max_bytes", self.max_bytes, 1, top))
        if self.max_message_bytes is not None:
            checks.integer("max_message_bytes", self.max_message_bytes, 1, MAX_SEQUENCE)


@dataclass(frozen=True)
class ReplayReply:
    """Messages out of a source's log, as they were put.

    Attributes:
        trajectory: its name.
        messages: encoded frames and controls of this trajectory, oldest first.
        position: where in the log the next batch begins; see ``after``.
        end: whether the log has nothing more at present.
        first_epoch, first_seq: the oldest message in the log; None where it is empty.
        last_epoch, last_seq: the newest one.
        dropped: unacknowledged messages of this trajectory that the log had no room for.
    """

    trajectory: str
    messages: tuple[bytes, ...]
    position: int
    end: bool
    first_epoch: str | None = None
    first_seq: int | None = None
    last_epoch: str | None = None
    last_seq: int | None = None
    dropped: int = 0
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        check_trajectory(self.trajectory, limits.max_name_length)
        put(self, "messages", checks.binaries("messages", self.messages))
        put(self, "position", checks.sequence("position", self.position))
        checks.flag("end", self.end)
        put(self, "first_seq", _check_place("first", self.first_epoch, self.first_seq))
        put(self, "last_seq", _check_place("last", self.last_epoch, self.last_seq))
        if self.messages and self.last_epoch is None:
            raise _half_told("last")
        put(self, "dropped", checks.sequence("dropped", self.dropped))


@dataclass(frozen=True)
class Durable:
    """What the service has on disk, so that a log need not keep it any longer.

    Attributes:
        trajectory: its name.
        epoch: the source's run; all runs before it are over and need not be kept either.
        seq: no frame and no control of a lower number can be of use again.
    """

    trajectory: str
    epoch: str
    seq: int
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        check_trajectory(self.trajectory, limits.max_name_length)
        checks.epoch("epoch", self.epoch)
        object.__setattr__(self, "seq", checks.sequence("seq", self.seq))


def _check_place(side: str, epoch: object, seq: object) -> int | None:
    if (epoch is None) != (seq is None):
        raise _half_told(side)
    if epoch is None:
        return None
    checks.epoch(f"{side}_epoch", epoch)
    return checks.sequence(f"{side}_seq", seq)


def _half_told(side: str) -> ProtocolError:
    return ProtocolError(
        ErrorCode.malformed,
        f"{side}_epoch or {side}_seq is missing",
        "both, or neither where the log is empty",
        details={"field": f"{side}_epoch"},
    )
