"""Answers on their way out: a thread of their own, so that no slow caller holds the pipeline up."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from koop_protocol import ErrorCode, ProtocolError
from koop_service.serving.answering.questions import Question, error_bytes

log = logging.getLogger("koop.answers")

_FULL = error_bytes(
    ProtocolError(
        ErrorCode.overloaded,
        "more answers wait for their callers than the service has room for",
        remedy="ask again later, or for less",
    )
)


@dataclass(frozen=True, slots=True)
class _Answer:
    """One answer; without `key` an error, without `payload` the end of the question's answers."""

    question: Question
    key: str | None
    payload: bytes | None


class Outbox:
    """Sends answers in order.

    What does not fit into its memory is given up and counted; the question's caller is told once.
    """

    def __init__(
        self,
        closed: Callable[[Question], None],
        unsent: Callable[[], None],
        max_bytes: int,
    ) -> None:
        self._closed = closed
        self._unsent = unsent
        self._max_bytes = max_bytes
        self._answers: deque[_Answer] = deque()
        self._bytes = 0
        self._given_up: set[Question] = set()
        self._work = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="koop-outbox", daemon=True)

    def start(self) -> None:
        """Begin sending."""
        self._thread.start()

    def stop(self, timeout: float) -> None:
        """Send what is there, for `timeout` [s] at most."""
        with self._work:
            self._stopping = True
            self._work.notify()
        self._thread.join(timeout)

    def reply(self, question: Question, key: str, payload: bytes) -> None:
        """Queue one answer."""
        self._put(_Answer(question, key, payload))

    def refuse(self, question: Question, payload: bytes) -> None:
        """Queue one error."""
        self._put(_Answer(question, None, payload))

    def close(self, question: Question) -> None:
        """Queue the end of the question's answers."""
        self._put(_Answer(question, None, None))

    def _put(self, answer: _Answer) -> None:
        size = len(answer.payload or b"")
        with self._work:
            if size and self._bytes + size > self._max_bytes:
                self._unsent()
                if answer.question in self._given_up:
                    return
                self._given_up.add(answer.question)
                answer, size = _Answer(answer.question, None, _FULL), len(_FULL)
            elif not size:
                self._given_up.discard(answer.question)
            self._bytes += size
            self._answers.append(answer)
            self._work.notify()

    def _run(self) -> None:
        while (answer := self._next()) is not None:
            try:
                self._send(answer)
            except Exception:
                # The caller may be gone; that is its business, and nobody else's.
                log.debug("an answer on %s could not be sent", answer.question.key, exc_info=True)
                self._unsent()

    def _next(self) -> _Answer | None:
        with self._work:
            self._work.wait_for(lambda: self._answers or self._stopping)
            if not self._answers:
                return None
            answer = self._answers.popleft()
            self._bytes -= len(answer.payload or b"")
            return answer

    def _send(self, answer: _Answer) -> None:
        if answer.payload is None:
            try:
                answer.question.close()
            finally:
                self._closed(answer.question)
        elif answer.key is None:
            answer.question.refuse(answer.payload)
        else:
            answer.question.reply(answer.key, answer.payload)
