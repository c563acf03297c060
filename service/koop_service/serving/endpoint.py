"""Zenoh's callbacks: each only puts what came into a queue, since it runs on the caller's link."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import zenoh

from koop_protocol import (
    CLIENT_TOKENS,
    CONTROLS,
    FRAMES,
    HEALTH,
    LQRS,
    PREDICTIONS,
    SOURCE_TOKENS,
    STATES,
    ErrorCode,
    KeyKind,
    ProtocolError,
    owner_of,
    trajectory_of,
)
from koop_service.serving.admission.intake import Intake
from koop_service.serving.admission.news import LogPresence, Presence
from koop_service.serving.admission.pace import Pace
from koop_service.serving.admission.strain import RETRY_AFTER
from koop_service.serving.answering.questions import (
    Question,
    ZenohQuestion,
    error_bytes,
    name_in,
)
from koop_service.serving.answering.shedding import Shedding
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.sharding.ownership import Ownership

log = logging.getLogger("koop.endpoint")

_QUERYABLES = {
    PREDICTIONS: KeyKind.predict,
    LQRS: KeyKind.lqr,
    STATES: KeyKind.state,
    HEALTH: KeyKind.health,
}
_BY_COUNT, _BY_RATE = "queries", "rate"
"""Reasons to shed a query before anybody looks at it."""


class Endpoint:
    """What the service hears: frames, controls, queries, and who is there."""

    def __init__(
        self,
        intake: Intake[Question],
        metrics: Metrics,
        max_bytes: int,
        pace: Pace,
        shedding: Shedding,
        ownership: Ownership | None = None,
    ) -> None:
        self._intake = intake
        self._metrics = metrics
        self._max_bytes = max_bytes
        self._pace = pace
        self._shedding = shedding
        self._ownership = ownership or Ownership()

    @contextmanager
    def declared(self, session: zenoh.Session) -> Iterator[None]:
        """Listen on the session as long as the context is open."""
        with ExitStack() as stack:
            callback = zenoh.handlers.Callback(self._meet, indirect=False)
            for key in self._ownership.keys(SOURCE_TOKENS):
                stack.enter_context(
                    session.liveliness().declare_subscriber(key, callback, history=True)
                )
            for key in self._ownership.keys(FRAMES) + self._ownership.keys(CONTROLS):
                callback = zenoh.handlers.Callback(self._measure, indirect=False)
                stack.enter_context(session.declare_subscriber(key, callback))
            callback = zenoh.handlers.Callback(self._notice, indirect=False)
            stack.enter_context(
                session.liveliness().declare_subscriber(CLIENT_TOKENS, callback, history=True)
            )
            for key, kind in _QUERYABLES.items():
                callback = zenoh.handlers.Callback(self._asker(kind), indirect=False)
                stack.enter_context(session.declare_queryable(key, callback))
            yield

    def _measure(self, sample: zenoh.Sample) -> None:
        key, size = str(sample.key_expr), len(sample.payload)
        if size > self._max_bytes:
            taken = self._intake.put(key, b"", _too_large(size, self._max_bytes))
        elif sample.kind == zenoh.SampleKind.DELETE:
            taken = self._intake.put(key, b"", _deleted())
        else:
            taken = self._intake.put(key, sample.payload.to_bytes())
        if not taken:
            self._metrics.lost.inc()

    def _notice(self, sample: zenoh.Sample) -> None:
        try:
            owner = owner_of(str(sample.key_expr))
        except ProtocolError as error:
            log.warning("a client's liveliness token is passed over: %s", error)
            return
        self._intake.notice(Presence(owner, sample.kind == zenoh.SampleKind.PUT))

    def _meet(self, sample: zenoh.Sample) -> None:
        try:
            trajectory = trajectory_of(str(sample.key_expr))
        except ProtocolError as error:
            log.warning("a source's liveliness token is passed over: %s", error)
            return
        self._intake.tell(LogPresence(trajectory, sample.kind == zenoh.SampleKind.PUT))

    def _asker(self, kind: KeyKind) -> Callable[[zenoh.Query], None]:
        def ask(query: zenoh.Query) -> None:
            name = None if kind is KeyKind.health else name_in(str(query.key_expr))
            size = 0 if query.payload is None else len(query.payload)
            if name is not None and not self._ownership.has(name):
                query.drop()  # its owner answers
            elif size > self._max_bytes:
                self._refuse(query, _too_large(size, self._max_bytes))
                return
            question = ZenohQuestion(kind, query)
            wait = self._pace.wait(question.key) if kind is KeyKind.predict else 0.0
            if wait:
                self._metrics.shed.labels(_BY_RATE).inc()
                self._refuse(query, _too_often(wait))
            elif (refusal := self._shedding.refusal(question)) is not None:
                self._refuse(query, refusal)
            elif not self._intake.ask(question, question.size, kind):
                self._metrics.shed.labels(_BY_COUNT).inc()
                self._refuse(query, _too_many())

        return ask

    def _refuse(self, query: zenoh.Query, error: ProtocolError) -> None:
        self._metrics.refused.labels(str(error.code)).inc()
        with query:
            query.reply_err(error_bytes(error))


def put_durable(session: zenoh.Session, key: str, payload: bytes) -> None:
    """Tell a source what its log need not keep; none of it may get lost, or the log fills up."""
    session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)


def put_notice(session: zenoh.Session, key: str, payload: bytes) -> None:
    """Send what may be lost, and must not hold anybody up."""
    session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)


def put_command(session: zenoh.Session, key: str, payload: bytes) -> None:
    """Send a command ahead of everything else, at once or not at all: an old one is of no use."""
    session.put(
        key,
        payload,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
    )


def _too_large(size: int, limit: int) -> ProtocolError:
    return ProtocolError(
        ErrorCode.too_large,
        f"the message has {size} bytes",
        f"at most {limit}",
        "send smaller or fewer images, or raise koop-serve's --max-message-bytes",
        {"limit": limit},
    )


def _deleted() -> ProtocolError:
    return ProtocolError(
        ErrorCode.malformed, "a delete came", "a put", "start a new epoch to begin afresh"
    )


def _too_many() -> ProtocolError:
    return ProtocolError(
        ErrorCode.overloaded,
        "the service has more queries than it can answer",
        remedy=f"ask again in {RETRY_AFTER:g} s, or less often",
        details={"reason": _BY_COUNT, "retry_after": RETRY_AFTER},
    )


def _too_often(wait: float) -> ProtocolError:
    return ProtocolError(
        ErrorCode.overloaded,
        "predictions of this trajectory are asked for too often",
        remedy=f"ask again in {wait:.2g} s, or raise --max-query-rate",
        details={"reason": _BY_RATE, "retry_after": wait},
    )
