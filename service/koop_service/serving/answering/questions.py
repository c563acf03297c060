"""A query as the pipeline sees it, and the thin wrapper that makes one of a Zenoh query."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Protocol, cast

import zenoh

from koop_protocol import ErrorReply, KeyKind, ProtocolError, encode


class Question(Protocol):
    """Something asked of the service, about one trajectory or, by wildcard, about several."""

    kind: KeyKind
    key: str
    parameters: dict[str, str]
    payload: bytes | None

    @property
    def size(self) -> int:
        """Bytes that it holds."""
        ...

    def age(self) -> float:
        """Time since it came [s]."""
        ...

    def matches(self, key: str) -> bool:
        """Whether an answer on `key` is asked for."""
        ...

    def reply(self, key: str, payload: bytes) -> None:
        """Send one answer."""
        ...

    def refuse(self, payload: bytes) -> None:
        """Send one error."""
        ...

    def close(self) -> None:
        """There is no further answer."""
        ...


class ZenohQuestion:
    """A Zenoh query. It must be closed, else its caller waits until the timeout."""

    def __init__(self, kind: KeyKind, query: zenoh.Query) -> None:
        self.kind = kind
        self._arrived = time.monotonic()
        self.key = str(query.key_expr)
        self.parameters = dict(cast(Iterable[tuple[str, str]], query.parameters))
        self.payload = None if query.payload is None else query.payload.to_bytes()
        self._query = query

    @property
    def size(self) -> int:
        return len(self.payload or b"")

    def age(self) -> float:
        return time.monotonic() - self._arrived

    def matches(self, key: str) -> bool:
        return self._query.key_expr.intersects(zenoh.KeyExpr(key))

    def reply(self, key: str, payload: bytes) -> None:
        self._query.reply(key, payload)

    def refuse(self, payload: bytes) -> None:
        self._query.reply_err(payload)

    def close(self) -> None:
        self._query.drop()


def name_in(key: str) -> str | None:
    """The one trajectory that a question on this key is about; None for one by wildcard."""
    return None if "*" in key or "$" in key else key.split("/", 2)[-1]


def error_bytes(error: ProtocolError) -> bytes:
    """The error as it travels; in short where it is itself too much for a message."""
    try:
        return encode(ErrorReply.from_error(error))
    except ProtocolError:
        return encode(ErrorReply(str(error.code)[:60], error.problem[:200]))
