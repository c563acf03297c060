"""Closed-loop control as a service: a task, its commands at each frame, and its end."""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field
from enum import StrEnum

from koop_protocol import checks
from koop_protocol.errors import ErrorCode
from koop_protocol.keys import check_owner, check_trajectory
from koop_protocol.limits import DEFAULT_LIMITS, MAX_SEQUENCE, MAX_TEXT_BYTES, Limits
from koop_protocol.lqr import LqrQuery, check_controls


class EndReason(StrEnum):
    """Why a task ended. The meanings stand in docs/wire.md."""

    cancelled = "cancelled"
    expired = "expired"
    owner_gone = "owner_gone"
    replaced_epoch = "replaced_epoch"
    evicted = "evicted"
    shutdown = "shutdown"


_END_REASONS = frozenset(reason.value for reason in EndReason)


@dataclass(frozen=True, eq=False)
class LqrTask:
    """Bring the system to a target and hold it there: plan anew at every frame, until it ends.

    Attributes:
        owner: the client, which has declared the liveliness token ``client_token(owner)``. A new
            task of the same owner replaces its former one on the trajectory.
        query: what to do; its sequences count from the frame at registration: at a frame k later,
            row k comes first. It asks for no ``returns``.
        seconds: after which the task ends by itself; None: not before its owner does.
        frozen: whether the model stays as it is at registration.
    """

    owner: str
    query: LqrQuery
    seconds: float | None = None
    frozen: bool = False
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        del limits  # the query has been held to them
        check_owner(self.owner)
        _check_query(self.query)
        if self.seconds is not None:
            object.__setattr__(self, "seconds", checks.real("seconds", self.seconds, 0.0))
        if self.seconds == 0.0:
            raise checks.fault(ErrorCode.malformed, "seconds", "is 0", "more than 0, or none")
        checks.flag("frozen", self.frozen)


@dataclass(frozen=True, eq=False)
class LqrCancel:
    """End the owner's task on the trajectory that it is sent to.

    Attributes:
        owner: the client that registered the task.
    """

    owner: str
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        del limits
        check_owner(self.owner)


@dataclass(frozen=True, eq=False)
class Command:
    """The plan from the newest frame; it replaces all earlier ones.

    Attributes:
        trajectory: its name.
        epoch: the source's run.
        seq: the newest frame that the service had folded.
        start: number of the interval that ``controls[0]`` acts in, seq + the task's delay.
        controls: (N, p) float64, in the control's unit: ``controls[i]`` acts between the frames
            start + i and start + i + 1. All but the first stand in where later commands are late.
        status: the solver's outcome; "failed": the rest of the last plan, or what is nearest to 0.
        cost: the objective, constant part included; 0 where it failed.
        kkt_residual: largest violation of the optimality conditions; 0 where it failed.
        owner: whose task it is.
    """

    trajectory: str
    epoch: str
    seq: int
    start: int
    controls: checks.Floats
    status: str
    cost: float
    kkt_residual: float
    owner: str
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        check_trajectory(self.trajectory, limits.max_name_length)
        checks.epoch("epoch", self.epoch)
        put(self, "seq", checks.sequence("seq", self.seq))
        put(self, "start", checks.integer("start", self.start, self.seq, MAX_SEQUENCE))
        put(self, "controls", check_controls("controls", self.controls, limits))
        checks.text("status", self.status, limits.max_name_length)
        put(self, "cost", checks.real("cost", self.cost))
        put(self, "kkt_residual", checks.real("kkt_residual", self.kkt_residual, 0.0))
        check_owner(self.owner)


@dataclass(frozen=True)
class LqrEnd:
    """There are no further commands of this task.

    Attributes:
        trajectory: its name.
        owner: whose task it was.
        reason: an EndReason.
        message: the same in words, for a person.
    """

    trajectory: str
    owner: str
    reason: EndReason
    message: str
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        check_trajectory(self.trajectory, limits.max_name_length)
        check_owner(self.owner)
        reason = checks.word("reason", self.reason, _END_REASONS)
        object.__setattr__(self, "reason", EndReason(reason))
        checks.text("message", self.message, MAX_TEXT_BYTES)


def _check_query(query: object) -> None:
    """A query that a command can answer: it may have come off the network as anything."""
    if not isinstance(query, LqrQuery):
        raise checks.fault(
            ErrorCode.wrong_type, "query", f"is {checks.shown(query)}", "an lqr_query"
        )
    if query.returns:
        raise checks.fault(
            ErrorCode.malformed,
            "query.returns",
            f"is {sorted(query.returns)}",
            "nothing: commands carry controls only",
            "ask for codes and frames by a query of its own, or by koop/predict",
        )
