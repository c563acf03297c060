"""Serving a log: a thread that answers the service's questions and forgets what it has safe.

Zenoh's callbacks only put what came into a queue; whoever appends never waits for an answer.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from koop_clients.replay.file import LogFile
from koop_protocol import (
    Durable,
    ErrorCode,
    ErrorReply,
    Limits,
    ProtocolError,
    ReplayQuery,
    decode_as,
    durable_key,
    encode,
    replay_key,
    source_token,
)

log = logging.getLogger("koop.log")

_TIDY = 1.0
"""Seconds between two times that the file is put in order, and what is durable forgotten: all at
once costs half of what it does one by one, as the service says it."""
_FAREWELL = 0.5
"""Longest wait at the end for a service that has not come round to a new log yet [s]."""
_WAITING = 1024
"""Questions that may wait; the service asks far fewer at once."""
_ROOMY = Limits().for_replays()


class LogServer:
    """Answers for the trajectories of a log on one session, from `start` until `close`."""

    def __init__(self, session: zenoh.Session, file: LogFile) -> None:
        self._session = session
        self._file = file
        self._declared: dict[str, list[Any]] = {}
        self._questions: deque[tuple[str, zenoh.Query]] = deque()
        self._durable: dict[str, Durable] = {}
        self._unread: set[str] = set()
        self._work = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="koop-log", daemon=True)

    def start(self) -> None:
        """Begin, with all trajectories that are in the log already."""
        self._thread.start()
        for trajectory in self._file.trajectories:
            self.serve(trajectory)

    def serve(self, trajectory: str) -> None:
        """Answer for this one too, and let the service know."""
        if trajectory in self._declared:
            return
        self._unread.add(trajectory)
        direct = partial(zenoh.handlers.Callback, indirect=False)
        ask, note = partial(self._ask, trajectory), partial(self._note, trajectory)
        self._declared[trajectory] = [
            self._session.declare_queryable(replay_key(trajectory), direct(ask)),
            self._session.declare_subscriber(durable_key(trajectory), direct(note)),
            # Last: whoever sees it may ask.
            self._session.liveliness().declare_token(source_token(trajectory)),
        ]

    def close(self) -> None:
        """Answer what was asked, and end. The session may be closed already.

        A service takes live frames only after it has read the log once; so it gets a moment to.
        """
        with self._work:
            self._work.wait_for(lambda: not self._unread, _FAREWELL)
        for declared in self._declared.values():
            for entity in reversed(declared):
                _undeclare(entity)
        with self._work:
            self._closing = True
            self._work.notify()
        self._thread.join()

    def _ask(self, trajectory: str, query: zenoh.Query) -> None:
        with self._work:
            if len(self._questions) < _WAITING and not self._closing:
                self._questions.append((trajectory, query))
                self._work.notify()
                return
        _refuse(query, ProtocolError(ErrorCode.overloaded, "the log has too many questions"))

    def _note(self, trajectory: str, sample: zenoh.Sample) -> None:
        try:
            durable = decode_as(Durable, sample.payload.to_bytes())
        except ProtocolError as error:
            log.warning("what is durable of %s cannot be read: %s", trajectory, error)
            return
        if durable.trajectory == trajectory:
            with self._work:
                self._durable[trajectory] = durable

    def _run(self) -> None:
        tidied = time.monotonic()
        while self._wait(tidied + _TIDY):
            self._guarded("answering", self._answer_all)
            if time.monotonic() - tidied >= _TIDY:
                self._guarded("forgetting", self._forget_all)
                self._guarded("tidying", self._file.tidy)
                tidied = time.monotonic()
        self._guarded("forgetting", self._forget_all)

    def _wait(self, until: float) -> bool:
        """Until there is a question, or the time [s] has come; whether to go on."""
        with self._work:
            self._work.wait_for(
                lambda: self._questions or self._closing, max(0.0, until - time.monotonic())
            )
            return bool(self._questions) or not self._closing

    def _guarded(self, doing: str, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception:
            log.exception("%s failed; the log goes on", doing)

    def _answer_all(self) -> None:
        while self._questions:
            trajectory, query = self._questions.popleft()
            with query:
                self._answer(trajectory, query)

    def _answer(self, trajectory: str, query: zenoh.Query) -> None:
        try:
            payload = query.payload
            asked = ReplayQuery() if payload is None else decode_as(ReplayQuery, payload.to_bytes())
            batch = self._file.read(trajectory, asked)
            reply = encode(batch, _ROOMY)
        except ProtocolError as error:
            query.reply_err(encode(ErrorReply.from_error(error)))
        except sqlite3.Error as error:
            refusal = ProtocolError(ErrorCode.internal, f"the log cannot be read: {error}")
            query.reply_err(encode(ErrorReply.from_error(refusal)))
        else:
            query.reply(replay_key(trajectory), reply)
            if batch.end:
                with self._work:
                    self._unread.discard(trajectory)
                    self._work.notify_all()

    def _forget_all(self) -> None:
        """All at once, which costs least, but for questions: they wait for nothing."""
        with self._work:
            durable, self._durable = self._durable, {}
        try:
            self._file.forget(durable.values(), between=self._answer_all)
        except sqlite3.Error:
            with self._work:
                self._durable = durable | self._durable
            raise


def _refuse(query: zenoh.Query, error: ProtocolError) -> None:
    with query:
        query.reply_err(encode(ErrorReply.from_error(error)))


def _undeclare(entity: Any) -> None:
    try:
        entity.undeclare()
    except zenoh.ZError:
        log.debug("the session was closed before the log", exc_info=True)
