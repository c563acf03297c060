"""Asks sources' logs over Zenoh, out of a thread of its own: a stuck link holds nobody up."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

import zenoh

from koop_protocol import ProtocolError, encode, replay_key
from koop_protocol.codec import decode
from koop_protocol.status import ErrorReply
from koop_service.serving.admission.news import LogAnswer, LogQuestion
from koop_service.serving.replay.catchup import ANSWERS

log = logging.getLogger("koop.replays")

_PATIENCE = 60.0
"""Longest wait for an answer [s]. It comes over the link of a source that may be held back, behind
all that waits there; where there is no source any more, Zenoh says so at once."""


class LogReader:
    """Sends questions in order; `deliver` gets one answer to each, from any thread."""

    def __init__(
        self, session: zenoh.Session, deliver: Callable[[LogAnswer], None], max_bytes: int
    ) -> None:
        self._session = session
        self._deliver = deliver
        self._max_bytes = max_bytes
        self._questions: deque[LogQuestion] = deque()
        self._under_way = 0  # bytes
        self._work = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="koop-replays", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self, timeout: float) -> None:
        """Ask nothing more; waits `timeout` [s] at most for a question that is being sent."""
        with self._work:
            self._stopping = True
            self._work.notify()
        self._thread.join(timeout)

    def ask(self, question: LogQuestion) -> None:
        """Queue a question; never waits."""
        with self._work:
            self._questions.append(question)
            self._work.notify()

    def _run(self) -> None:
        while (question := self._next()) is not None:
            reply = _Reply(question, self._max_bytes)
            try:
                self._session.get(
                    replay_key(question.trajectory),
                    zenoh.handlers.Callback(
                        reply.take, lambda reply=reply: self._done(reply), indirect=False
                    ),
                    payload=encode(question.query),
                    timeout=_PATIENCE,
                )
            except zenoh.ZError as error:
                log.debug("a log could not be asked", exc_info=True)
                reply.problem = str(error)
                self._done(reply)

    def _next(self) -> LogQuestion | None:
        with self._work:
            self._work.wait_for(
                lambda: self._stopping or (self._questions and self._under_way < ANSWERS)
            )
            if self._stopping:
                return None
            question = self._questions.popleft()
            self._under_way += question.query.max_bytes
            return question

    def _done(self, reply: _Reply) -> None:
        with self._work:
            if reply.is_done:
                return
            reply.is_done = True
            self._under_way -= reply.question.query.max_bytes
            self._work.notify()
        self._deliver(LogAnswer(reply.question, reply.payload, reply.problem, reply.is_late))


class _Reply:
    """The first answer to one question."""

    def __init__(self, question: LogQuestion, max_bytes: int) -> None:
        self.question = question
        self.payload: bytes | None = None
        self.problem = "nobody answered"
        self._asked = time.monotonic()
        self.is_done = False
        self._max_bytes = max_bytes

    @property
    def is_late(self) -> bool:
        """Whether it took as long as anybody waits."""
        return self.payload is None and time.monotonic() - self._asked > _PATIENCE - 1.0

    def take(self, reply: zenoh.Reply) -> None:
        if self.payload is not None:
            return
        if reply.ok is None:
            self.problem = _words(reply.err)
        elif len(reply.ok.payload) > self._max_bytes:
            self.problem = f"it answered with {len(reply.ok.payload)} bytes at once"
        else:
            self.payload = reply.ok.payload.to_bytes()


def _words(error: zenoh.ReplyError | None) -> str:
    if error is None or len(error.payload) > 1 << 16:
        return "it answered with an error"
    try:
        message = decode(error.payload.to_bytes())
    except ProtocolError:
        return "it answered with an error that cannot be read"
    return message.message if isinstance(message, ErrorReply) else "it answered with nonsense"
