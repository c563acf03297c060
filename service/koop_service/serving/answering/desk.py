"""Questions in the pipeline: each waits for what its trajectory sent before, then is answered.

A question about one trajectory is answered as soon as everything that this trajectory sent before
it is folded; where the trajectory is catching up with its source's log, half a second after it came
at the latest, out of what is folded by then. One by wildcard waits for everybody's, and is then
answered a trajectory at a time, so that it cannot hold the measurements up for long.

What concerns control goes first, then states, then predictions. Costly predictions are shed while
there is a strain (see `admission/strain.py`). Health waits for nothing.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from koop_protocol import (
    HEALTH,
    ErrorCode,
    KeyKind,
    ProtocolError,
    check_trajectory,
    encode,
    lqr_key,
    predict_key,
    state_key,
)
from koop_service.serving.admission.intake import Intake
from koop_service.serving.answering.outbox import Outbox
from koop_service.serving.answering.questions import Question, error_bytes, name_in
from koop_service.serving.answering.replies import Answer, Replies
from koop_service.serving.answering.shedding import Shedding
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.monitoring.vitals import Vitals
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.sharding.ownership import Ownership
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory

log = logging.getLogger("koop.queries")

_CATCHING_UP = 0.5
"""Longest wait for a trajectory that catches up [s]."""

_KEYS = {KeyKind.predict: predict_key, KeyKind.lqr: lqr_key, KeyKind.state: state_key}
_TURNS = (KeyKind.lqr, KeyKind.state, KeyKind.predict)
"""Who is answered first."""


@dataclass(eq=False)
class _Pending:
    """A question that waits for measurements older than `ticket`; `lane` None: everybody's."""

    question: Question
    ticket: int
    lane: str | None
    answers: Iterator[None] | None = field(default=None)


class Desk:
    """Answers questions out of the pipeline's thread, the only one that sees the trajectories."""

    def __init__(
        self,
        intake: Intake[Question],
        registry: Registry,
        replies: Replies,
        recovery: Recovery,
        outbox: Outbox,
        metrics: Metrics,
        vitals: Vitals,
        shedding: Shedding,
        ownership: Ownership | None = None,
    ) -> None:
        self._ownership = ownership or Ownership()
        self._intake = intake
        self._registry = registry
        self._replies = replies
        self._recovery = recovery
        self._outbox = outbox
        self._metrics = metrics
        self._vitals = vitals
        self._shedding = shedding
        self._pending: dict[KeyKind, deque[_Pending]] = {kind: deque() for kind in _TURNS}
        self._brake = Brake()

    def collect(self) -> None:
        """Take in the questions that have come, and say at once that we live."""
        for waiting in self._intake.take_queries():
            question = waiting.query
            if question.kind is KeyKind.health:
                self._outbox.reply(question, HEALTH, encode(self._vitals.report()))
                self._outbox.close(question)
                continue
            lane = name_in(question.key)
            self._pending[question.kind].append(_Pending(question, waiting.ticket, lane))

    @property
    def busy(self) -> bool:
        """Whether there is something to do for an answer, at once."""
        return any(
            not self._waits(pending) and (pending.lane is not None or self._is_due(pending))
            for pending in self._waiting()
        )

    @property
    def waits(self) -> bool:
        """Whether somebody waits for an answer."""
        return any(self._pending.values())

    def urgent(self) -> Iterator[tuple[str, int]]:
        """Trajectories that a question waits for, and before which ticket."""
        for pending in self._waiting():
            if pending.lane is not None and pending.answers is None:
                yield pending.lane, pending.ticket

    def answer(self, budget: float) -> None:
        """Answer what is due, each kind oldest first, for about `budget` [s]."""
        deadline = time.monotonic() + budget
        for queue in self._pending.values():
            for _ in range(len(queue)):
                pending = queue.popleft()
                if not self._is_due(pending) or not self._work_on(pending, deadline):
                    queue.append(pending)

    def abandon(self) -> None:
        """Tell everybody who still waits that the service is going down."""
        self.collect()
        for pending in self._waiting():
            error = ProtocolError(
                ErrorCode.overloaded, "the service is shutting down", remedy="ask again later"
            )
            self._refuse(pending.question, error)
            self._outbox.close(pending.question)
        for queue in self._pending.values():
            queue.clear()

    def _waiting(self) -> Iterator[_Pending]:
        return (pending for queue in self._pending.values() for pending in queue)

    def _is_due(self, pending: _Pending) -> bool:
        if pending.answers is not None or self._shedding.forbids(pending.question):
            return True
        behind = self._intake.is_behind(pending.ticket, pending.lane)
        return not behind and not self._waits(pending)

    def _waits(self, pending: _Pending) -> bool:
        """Whether it waits for its trajectory to catch up."""
        if pending.lane is None or not self._recovery.is_behind(pending.lane):
            return False
        return pending.question.age() < _CATCHING_UP

    def _work_on(self, pending: _Pending, deadline: float) -> bool:
        """Go on answering; False if time was up before the last answer."""
        if pending.answers is None:
            pending.answers = self._answers(pending.question)
        while time.monotonic() < deadline:
            if self._advance(pending):
                return True
        return False

    def _advance(self, pending: _Pending) -> bool:
        """Send one more answer; True after the last."""
        question = pending.question
        try:
            next(pending.answers or iter(()))
            return False
        except StopIteration:
            pass
        except ProtocolError as error:
            self._refuse(question, error)
        except Exception:
            self._fail(question)
        self._outbox.close(question)
        return True

    def _answers(self, question: Question) -> Iterator[None]:
        refusal = self._shedding.refusal(question)
        if refusal is not None:
            raise refusal
        name = name_in(question.key)
        if name is None:
            yield from self._answers_of_several(question)
        else:
            answer = self._replies.understand(question).answer
            yield self._send(question, answer, self._find(name))

    def _answers_of_several(self, question: Question) -> Iterator[None]:
        """One each. Where other workers hear the question too, one of all complains about it, and
        none knows that there is no such trajectory."""
        try:
            answer = self._replies.understand(question).answer
        except ProtocolError:
            if self._ownership.speaks_for_all:
                raise
            return
        names = [n for n in self._registry.names() if question.matches(_KEYS[question.kind](n))]
        if not names and self._ownership.whole:
            raise ProtocolError(
                ErrorCode.unknown_trajectory,
                f"no trajectory matches {question.key!r}",
                remedy="stream frames first, for instance with: koop-sim-client --system cartpole",
            )
        for name in names:
            yield self._answer_one_of_several(question, answer, name)

    def _answer_one_of_several(self, question: Question, answer: Answer, name: str) -> None:
        """An answer or an error for this one; the others get theirs in any case."""
        trajectory = self._registry.held(name)
        if trajectory is None:
            return  # it was evicted between two answers
        try:
            self._send(question, answer, trajectory)
        except ProtocolError as error:
            details = {**error.details, "trajectory": name}
            message = f"{name}: {error.problem}"
            self._refuse(
                question,
                ProtocolError(error.code, message, error.expected, error.remedy, details),
            )
        except Exception:
            self._fail(question)

    def _send(self, question: Question, answer: Answer, trajectory: Trajectory) -> None:
        key = _KEYS[question.kind](trajectory.name)
        self._outbox.reply(question, key, answer(trajectory))

    def _find(self, name: str) -> Trajectory:
        check_trajectory(name)
        trajectory = self._registry.find(name)
        if trajectory is None:
            raise self._registry.why_unknown(name)
        return trajectory

    def _refuse(self, question: Question, error: ProtocolError) -> None:
        self._metrics.refused.labels(str(error.code)).inc()
        self._outbox.refuse(question, error_bytes(error))

    def _fail(self, question: Question) -> None:
        if self._brake.admit(question.kind) is not None:
            log.exception("answering %r failed; the service goes on", question.key[:200])
        error = ProtocolError(
            ErrorCode.internal,
            "the service failed at this query; its log has the traceback",
            remedy="please report it",
        )
        self._refuse(question, error)
