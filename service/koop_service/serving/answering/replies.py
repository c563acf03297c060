"""From a question's bytes to the function that answers it, and whether that costs much."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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
    decode,
    decode_as,
    encode,
    predict_query_from_parameters,
)
from koop_service.serving.answering import queries
from koop_service.serving.answering.questions import Question, name_in
from koop_service.serving.steering.commander import Commander
from koop_service.serving.trajectories.trajectory import Trajectory

Answer = Callable[[Trajectory], bytes]

_COSTLY = frozenset({"frames", "std"})
"""What takes many times as long as the codes alone."""


@dataclass(frozen=True)
class Reply:
    """answer: from a trajectory to the reply's bytes. costly: to be shed where time is short."""

    answer: Answer
    costly: bool


class Replies:
    """Understands questions, in any thread; what answers them is for the pipeline's alone."""

    def __init__(self, commander: Commander, limits: Limits, outgoing: Limits) -> None:
        """`limits` are those of questions, `outgoing` of the answers."""
        self._commander = commander
        self._limits = limits
        self._outgoing = outgoing

    def understand(self, question: Question) -> Reply:
        """What to do about the question. Raises ProtocolError where it cannot be understood."""
        if question.kind is KeyKind.state:
            return self._reply(queries.state)
        if question.kind is KeyKind.lqr:
            return self._control(decode(_required(question.payload), self._limits))
        prediction = self._prediction(question)
        costly = name_in(question.key) is None or not _COSTLY.isdisjoint(prediction.returns)
        return self._reply(
            lambda trajectory: queries.predict(trajectory, prediction, self._outgoing), costly
        )

    def is_costly(self, question: Question) -> bool:
        """Whether the question is to be shed first; False where it cannot be understood."""
        try:
            return self.understand(question).costly
        except ProtocolError:
            return False

    def _reply(self, reply: Callable[[Trajectory], Message], costly: bool = False) -> Reply:
        return Reply(lambda trajectory: encode(reply(trajectory), self._outgoing), costly)

    def _prediction(self, question: Question) -> PredictQuery:
        if question.payload is None:
            return predict_query_from_parameters(question.parameters, self._limits)
        return decode_as(PredictQuery, question.payload, self._limits)

    def _control(self, order: Message) -> Reply:
        """Tasks are never shed, nor is a plan without pictures: somebody may steer by it."""
        if isinstance(order, LqrQuery):
            costly = not _COSTLY.isdisjoint(order.returns)
            return self._reply(
                lambda trajectory: queries.control(trajectory, order, self._outgoing), costly
            )
        if isinstance(order, LqrTask):
            return self._reply(lambda trajectory: self._commander.begin(trajectory, order))
        if isinstance(order, LqrCancel):
            return self._reply(lambda trajectory: self._commander.cancel(trajectory, order))
        raise ProtocolError(
            ErrorCode.malformed,
            f"a {type(order).__name__} came as a query",
            "an lqr_query, lqr_task or lqr_cancel message",
            "send each message on the key that docs/wire.md names for it",
        )


def _required(payload: bytes | None) -> bytes:
    if payload is None:
        raise ProtocolError(
            ErrorCode.malformed,
            "the query has no payload",
            "an lqr_query, lqr_task or lqr_cancel message as its payload",
            "see docs/wire.md",
        )
    return payload
