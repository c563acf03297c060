"""Closed-loop tasks by trajectory: begun, carried on from frame to frame, ended.

Nothing here knows how messages come and go. Owned by the pipeline's thread.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Container
from dataclasses import dataclass

from koop_protocol import (
    Command,
    EndReason,
    ErrorCode,
    LqrEnd,
    LqrReply,
    LqrTask,
    ProtocolError,
    client_token,
)
from koop_service.prediction.model import LinearModel
from koop_service.serving.steering.aims import MAX_COMMANDED
from koop_service.serving.steering.courses import Course
from koop_service.serving.steering.outset import set_out
from koop_service.serving.trajectories.trajectory import Trajectory

FAILED = "failed"
"""Status of a command without a plan of its own: it carries the rest of the last one."""

_WORDS = {
    EndReason.cancelled: "the owner cancelled the task",
    EndReason.expired: "the task's time is over; register it again to go on",
    EndReason.owner_gone: "the owner's liveliness token is gone",
    EndReason.replaced_epoch: "the source began a new epoch; register the task again to go on",
    EndReason.evicted: "the service holds the trajectory no more",
    EndReason.shutdown: "the service is shutting down",
}


@dataclass(frozen=True, eq=False)
class Task:
    """frozen: the model that it keeps, None where it learns. deadline: by the clock [s]."""

    trajectory: str
    owner: str
    epoch: str
    course: Course
    frozen: LinearModel | None
    deadline: float

    def command(self, trajectory: Trajectory) -> Command:
        """The plan from the newest frame; where there is none, the rest of the last one."""
        seq, course = trajectory.last_seq, self.course
        try:
            model = self.frozen or trajectory.model()
            found = course.plan(model, trajectory.recent_codes(), seq).solution
        except ValueError:
            outcome = course.rest(seq), FAILED, 0.0, 0.0
        else:
            outcome = found.u, found.status, found.cost, found.kkt_residual
        return Command(self.trajectory, self.epoch, seq, course.start(seq), *outcome, self.owner)

    def end(self, reason: EndReason) -> LqrEnd:
        """The message that it is over."""
        return LqrEnd(self.trajectory, self.owner, reason, _WORDS[reason])


class Tasks:
    """At most one task a trajectory, and whom they belong to."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._tasks: dict[str, Task] = {}
        self._owners: set[str] = set()

    def __len__(self) -> int:
        return len(self._tasks)

    def find(self, name: str) -> Task | None:
        """The task on the trajectory of that name."""
        return self._tasks.get(name)

    def welcome(self, owner: str) -> None:
        """The owner's token was declared."""
        self._owners.add(owner)

    def bid_farewell(self, owner: str) -> list[LqrEnd]:
        """The owner's token is gone, and so are its tasks."""
        self._owners.discard(owner)
        return self._end_where(lambda task: task.owner == owner, EndReason.owner_gone)

    def begin(self, trajectory: Trajectory, order: LqrTask) -> LqrReply:
        """Begin a task, in the place of its owner's former one, where the model is fit for it.

        Raises ProtocolError: task_taken, no_owner, and as `set_out`.
        """
        self._check_owner(order.owner)
        former = self._own(trajectory.name, order.owner)
        schedule = former and former.course.schedule
        outset = set_out(trajectory, order.query, schedule, MAX_COMMANDED)
        if outset.course is not None:
            self._tasks[trajectory.name] = Task(
                trajectory.name,
                order.owner,
                trajectory.epoch,
                outset.course,
                outset.model if order.frozen else None,
                self._clock() + (math.inf if order.seconds is None else order.seconds),
            )
        return outset.reply

    def cancel(self, name: str, owner: str) -> LqrEnd:
        """End the owner's task; ProtocolError (no_task, task_taken) where there is none of its."""
        task = self._own(name, owner)
        if task is None:
            raise ProtocolError(
                ErrorCode.no_task,
                f"the trajectory {name!r} has no task",
                "one that began and has not ended",
                details={"trajectory": name},
            )
        return self._end(task, EndReason.cancelled)

    def command(self, trajectory: Trajectory) -> Command | LqrEnd | None:
        """What the trajectory's task says at its newest frame; None without a task."""
        task = self._tasks.get(trajectory.name)
        if task is None:
            return None
        if task.epoch != trajectory.epoch:
            return self._end(task, EndReason.replaced_epoch)
        return task.command(trajectory)

    def expire(self) -> list[LqrEnd]:
        """End those whose time is over."""
        now = self._clock()
        return self._end_where(lambda task: task.deadline <= now, EndReason.expired)

    def evict(self, held: Container[str]) -> list[LqrEnd]:
        """End those on trajectories that are not `held` any more."""
        return self._end_where(lambda task: task.trajectory not in held, EndReason.evicted)

    def shut_down(self) -> list[LqrEnd]:
        """End all."""
        return self._end_where(lambda _: True, EndReason.shutdown)

    def _check_owner(self, owner: str) -> None:
        if owner not in self._owners:
            raise ProtocolError(
                ErrorCode.no_owner,
                f"the owner {owner!r} has no liveliness token here",
                f"the token {client_token(owner)!r}",
                "declare it, on the session that asks, before the task, and keep it as long as"
                " commands are wanted",
                {"owner": owner},
            )

    def _own(self, name: str, owner: str) -> Task | None:
        """The owner's task on the trajectory; ProtocolError where it is somebody else's."""
        task = self._tasks.get(name)
        if task is not None and task.owner != owner:
            raise ProtocolError(
                ErrorCode.task_taken,
                f"the trajectory {name!r} is controlled by {task.owner!r}",
                "a trajectory without another owner's task",
                "wait until that owner cancels its task or is gone",
                {"owner": task.owner, "trajectory": name},
            )
        return task

    def _end_where(self, matches: Callable[[Task], bool], reason: EndReason) -> list[LqrEnd]:
        return [self._end(task, reason) for task in list(self._tasks.values()) if matches(task)]

    def _end(self, task: Task, reason: EndReason) -> LqrEnd:
        del self._tasks[task.trajectory]
        return task.end(reason)
