"""Whether the service lives, and when a trajectory in it ends."""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field
from enum import StrEnum

from koop_protocol import checks
from koop_protocol.keys import check_trajectory
from koop_protocol.limits import DEFAULT_LIMITS, MAX_TEXT_BYTES, Limits

OVERLOADED = "overloaded"
"""Costly predictions are refused, since measurements come faster than they are folded."""
SHORT_OF_MEMORY = "short_of_memory"
"""New trajectories and costly predictions are refused."""
NOT_DURABLE = "not_durable"
"""Snapshots cannot be written at present."""
CATCHING_UP = "catching_up"
"""Some trajectories are being read from their source's log."""
ENCODER_FAILS = "encoder_fails"
"""Frames of some model cannot be encoded at present."""


@dataclass(frozen=True)
class Health:
    """The pipeline moves: it answered this itself.

    Attributes:
        worker: the process, as host:pid.
        version: koop's, such as "0.1.0".
        uptime: since it began to serve [s].
        trajectories: held in memory.
        queue: measurements waiting.
        queries: queries not answered yet.
        last_fold: time since a measurement was last folded [s]; None before the first.
        degraded: what is not as it should be, such as OVERLOADED; receivers pass over words that
            they do not know.
    """

    worker: str
    version: str
    uptime: float
    trajectories: int
    queue: int
    queries: int
    last_fold: float | None = None
    degraded: tuple[str, ...] = ()
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        for name in ("worker", "version"):
            checks.text(name, getattr(self, name), limits.max_name_length)
        put(self, "uptime", checks.real("uptime", self.uptime, 0.0))
        for name in ("trajectories", "queue", "queries"):
            put(self, name, checks.sequence(name, getattr(self, name)))
        if self.last_fold is not None:
            put(self, "last_fold", checks.real("last_fold", self.last_fold, 0.0))
        words = checks.texts("degraded", self.degraded, limits.max_name_length)
        put(self, "degraded", words)


class Ending(StrEnum):
    """Why a trajectory, or a run of it, is over in the service."""

    replaced_epoch = "replaced_epoch"
    source_gone = "source_gone"
    evicted = "evicted"


@dataclass(frozen=True)
class TrajectoryEnd:
    """A run of a trajectory is over, or nobody streams it any more.

    Attributes:
        trajectory: its name.
        epoch: the run that is over.
        next_seq: the frame that would have come next.
        reason: an Ending.
        message: the same for a person.
    """

    trajectory: str
    epoch: str
    next_seq: int
    reason: Ending
    message: str
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        check_trajectory(self.trajectory, limits.max_name_length)
        checks.epoch("epoch", self.epoch)
        object.__setattr__(self, "next_seq", checks.sequence("next_seq", self.next_seq))
        object.__setattr__(self, "reason", Ending(checks.word("reason", self.reason, _ENDINGS)))
        checks.text("message", self.message, MAX_TEXT_BYTES)


_ENDINGS = frozenset(ending.value for ending in Ending)
