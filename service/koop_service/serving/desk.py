"""Questions in the pipeline: each waits for what its trajectory sent before, then is answered.

A question about one trajectory is answered as soon as everything that this trajectory sent before
it is folded. One by wildcard waits for everybody's, and is then answered a trajectory at a time, so
that it cannot hold the measurements up for long.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from koop_protocol import (
    ErrorCode,
    KeyKind,
    Limits,
    LqrCancel,
    LqrQuery,
    LqrTask,
    Message,
    PredictQuery,
    ProtocolError,
    check_trajectory,
    decode,
    decode_as,
    encode,
    lqr_key,
    predict_key,
    predict_query_from_parameters,
    state_key,
)
from koop_service.serving import queries
from koop_service.serving.intake import Intake
from koop_service.serving.logs import Brake
from koop_service.serving.metrics import Metrics
from koop_service.serving.outbox import Outbox
from koop_service.serving.questions import Question, error_bytes, is_wildcard
from koop_service.serving.registry import Registry
from koop_service.serving.steering.commander import Commander
from koop_service.serving.trajectories import Trajectory

log = logging.getLogger("koop.queries")

_Answer = Callable[[Trajectory], bytes]

_KEYS = {KeyKind.predict: predict_key, KeyKind.lqr: lqr_key, KeyKind.state: state_key}


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
        commander: Commander,
        outbox: Outbox,
        metrics: Metrics,
        limits: Limits,
    ) -> None:
        self._intake = intake
        self._registry = registry
        self._commander = commander
        self._outbox = outbox
        self._metrics = metrics
        self._limits = limits
        self._pending: deque[_Pending] = deque()
        self._brake = Brake()

    def collect(self) -> None:
        """Take in the questions that have come."""
        for waiting in self._intake.take_queries():
            question = waiting.query
            lane = None if is_wildcard(question) else _name_in(question)
            self._pending.append(_Pending(question, waiting.ticket, lane))

    @property
    def busy(self) -> bool:
        """Whether there is something to do for an answer, at once."""
        return any(pending.lane is not None or self._is_due(pending) for pending in self._pending)

    def urgent(self) -> Iterator[tuple[str, int]]:
        """Trajectories that a question waits for, and before which ticket."""
        for pending in self._pending:
            if pending.lane is not None and pending.answers is None:
                yield pending.lane, pending.ticket

    def answer(self, budget: float) -> None:
        """Answer what is due, oldest first, for about `budget` [s]."""
        deadline = time.monotonic() + budget
        for _ in range(len(self._pending)):
            pending = self._pending.popleft()
            if not self._is_due(pending) or not self._work_on(pending, deadline):
                self._pending.append(pending)

    def abandon(self) -> None:
        """Tell everybody who still waits that the service is going down."""
        self.collect()
        for pending in self._pending:
            error = ProtocolError(
                ErrorCode.overloaded, "the service is shutting down", remedy="ask again later"
            )
            self._refuse(pending.question, error)
            self._outbox.close(pending.question)
        self._pending.clear()

    def _is_due(self, pending: _Pending) -> bool:
        if pending.answers is not None:
            return True
        return not self._intake.is_behind(pending.ticket, pending.lane)

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
        answer = self._understand(question)
        if not is_wildcard(question):
            yield self._send(question, answer, self._find(_name_in(question)))
            return
        names = [n for n in self._registry.names() if question.matches(_KEYS[question.kind](n))]
        if not names:
            raise ProtocolError(
                ErrorCode.unknown_trajectory,
                f"no trajectory matches {question.key!r}",
                remedy="stream frames first, for instance with: koop-sim-client --system cartpole",
            )
        for name in names:
            yield self._answer_one_of_several(question, answer, name)

    def _answer_one_of_several(self, question: Question, answer: _Answer, name: str) -> None:
        """An answer or an error for this one; the others get theirs in any case."""
        trajectory = self._registry.find(name)
        if trajectory is None:
            return
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

    def _send(self, question: Question, answer: _Answer, trajectory: Trajectory) -> None:
        key = _KEYS[question.kind](trajectory.name)
        self._outbox.reply(question, key, answer(trajectory))

    def _understand(self, question: Question) -> _Answer:
        """The function from a trajectory to the reply's bytes. Raises ProtocolError."""
        reply = self._replier(question)
        return lambda trajectory: encode(reply(trajectory), self._limits)

    def _replier(self, question: Question) -> Callable[[Trajectory], Message]:
        limits, payload = self._limits, question.payload
        if question.kind is KeyKind.state:
            return queries.state
        if question.kind is KeyKind.lqr:
            return self._controller(decode(_required(payload), limits))
        if payload is None:
            prediction = predict_query_from_parameters(question.parameters, limits)
        else:
            prediction = decode_as(PredictQuery, payload, limits)
        return lambda trajectory: queries.predict(trajectory, prediction)

    def _controller(self, order: Message) -> Callable[[Trajectory], Message]:
        if isinstance(order, LqrQuery):
            return lambda trajectory: queries.control(trajectory, order)
        if isinstance(order, LqrTask):
            return lambda trajectory: self._commander.begin(trajectory, order)
        if isinstance(order, LqrCancel):
            return lambda trajectory: self._commander.cancel(trajectory, order)
        raise ProtocolError(
            ErrorCode.malformed,
            f"a {type(order).__name__} came as a query",
            "an lqr_query, lqr_task or lqr_cancel message",
            "send each message on the key that docs/wire.md names for it",
        )

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


def _name_in(question: Question) -> str:
    return question.key.split("/", 2)[-1]


def _required(payload: bytes | None) -> bytes:
    if payload is None:
        raise ProtocolError(
            ErrorCode.malformed,
            "the query has no payload",
            "an lqr_query, lqr_task or lqr_cancel message as its payload",
            "see docs/wire.md",
        )
    return payload
