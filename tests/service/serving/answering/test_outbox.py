"""Answers on their way out: in order, bounded, and unharmed by callers that went away."""

from __future__ import annotations

import threading

from koop_protocol import ErrorCode, ErrorReply, KeyKind, decode_as
from koop_service.serving.answering.outbox import Outbox


class Caller:
    """A question that notes what it is answered, and may refuse to take it."""

    kind, key, parameters, payload = KeyKind.state, "koop/state/a", {}, None

    def __init__(self, gate: threading.Event | None = None, gone: bool = False) -> None:
        self.got, self._gate, self._gone = [], gate, gone

    size = 0

    def age(self) -> float:
        return 0.0

    def matches(self, key: str) -> bool:
        return bool(key)

    def reply(self, key: str, payload: bytes) -> None:
        assert key == "k"
        if self._gate:
            self._gate.wait(10)
        if self._gone:
            raise ConnectionError("gone")
        self.got.append(payload)

    def refuse(self, payload: bytes) -> None:
        self.got.append(("error", payload))

    def close(self) -> None:
        self.got.append("end")


def outbox(max_bytes: int = 1000) -> tuple[Outbox, list, list]:
    closed, unsent = [], []
    box = Outbox(closed.append, lambda: unsent.append(1), max_bytes)
    box.start()
    return box, closed, unsent


def test_answers_go_out_in_order() -> None:
    box, closed, unsent = outbox()
    caller = Caller()
    box.reply(caller, "k", b"1")
    box.refuse(caller, b"2")
    box.reply(caller, "k", b"3")
    box.close(caller)
    box.stop(10)
    assert caller.got == [b"1", ("error", b"2"), b"3", "end"]
    assert closed == [caller]
    assert not unsent


def test_a_caller_that_is_gone_harms_nobody() -> None:
    box, closed, unsent = outbox()
    gone, other = Caller(gone=True), Caller()
    for caller in (gone, other):
        box.reply(caller, "k", b"1")
        box.close(caller)
    box.stop(10)
    assert gone.got == ["end"]
    assert other.got == [b"1", "end"]
    assert closed == [gone, other]
    assert len(unsent) == 1


def test_a_caller_that_does_not_read_costs_bounded_memory_and_is_told_once() -> None:
    box, closed, unsent = outbox(max_bytes=250)
    gate = threading.Event()
    slow = Caller(gate)
    for _ in range(10):
        box.reply(slow, "k", bytes(100))
    box.close(slow)
    assert 6 <= len(unsent) <= 8  # one is being sent, two fit
    gate.set()
    box.stop(10)
    errors = [answer[1] for answer in slow.got if isinstance(answer, tuple)]
    assert [decode_as(ErrorReply, error).code for error in errors] == [ErrorCode.overloaded]
    assert len(slow.got) == 10 - len(unsent) + len(errors) + 1
    assert closed == [slow]


def test_who_asks_again_is_told_again() -> None:
    box, closed, unsent = outbox(max_bytes=10)
    callers = [Caller(), Caller()]
    for caller in (*callers, callers[0]):
        box.reply(caller, "k", bytes(11))
        box.close(caller)
    box.stop(10)
    assert [len(caller.got) for caller in callers] == [4, 2]
    assert closed == [*callers, callers[0]]
    assert len(unsent) == 3
