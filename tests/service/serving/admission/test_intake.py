"""The queues: order, the short cut, the bounds."""

from __future__ import annotations

import threading
import time

import pytest

from koop_service.serving.admission import shares
from koop_service.serving.admission.arrivals import Arrival
from koop_service.serving.admission.intake import Intake


def key(name: str) -> str:
    return f"koop/frame/00/{name}"


def intake(messages: int = 100, size: int = 10_000, queries: int = 3) -> Intake[str]:
    return Intake(messages, size, queries)


def names(batch: list[Arrival]) -> list[bytes]:
    return [arrival.data for arrival in batch]


def drained(queue: Intake[str]) -> list[bytes]:
    """Everything that waits, as fast as it is given."""
    got = []
    while queue.depth:
        queue.wait(1.0)
        got += names(queue.take(9))
    return got


def test_measurements_come_out_in_turn_and_in_order() -> None:
    queue = intake()
    for i in range(5):
        queue.put(key(str(i % 2)), bytes([i]))
    assert names(queue.take(3)) == [b"\0", b"\1", b"\2"]
    assert drained(queue) == [b"\3", b"\4"]
    assert queue.take(1) == []


def test_the_short_cut_takes_what_came_before_the_question_and_no_more() -> None:
    queue = intake()
    for i in range(3):
        queue.put(key("a"), bytes([i]))
        queue.put(key("b"), bytes([10 + i]))
    queue.ask("about b")
    queue.put(key("b"), b"later")
    (waiting,) = queue.take_queries()
    assert queue.is_behind(waiting.ticket, "b")
    assert names(queue.take_of("b", waiting.ticket, 2)) == [b"\x0a", b"\x0b"]
    assert names(queue.take_of("b", waiting.ticket, 9)) == [b"\x0c"]
    assert not queue.is_behind(waiting.ticket, "b")
    assert queue.is_behind(waiting.ticket, None)
    assert sorted(drained(queue)) == [b"\0", b"\1", b"\2", b"later"]
    assert not queue.is_behind(waiting.ticket, None)
    assert queue.depth == 0


def test_waiting_ends_when_a_share_has_its_turn_again() -> None:
    """Two are active, and one has used up its pace: the clock alone must end the wait."""
    queue = intake()
    queue.put(key("a"), b"x")
    for i in range(9):
        queue.put(key("b"), bytes([i]))
    got = names(queue.take(99))
    assert len(got) < 10
    while len(got) < 10:
        queue.wait(30.0)
        got += names(queue.take(99))
    assert got == [b"x", *(bytes([i]) for i in range(9))]


@pytest.mark.parametrize("bounds", [{"messages": 2}, {"size": 20}])
def test_a_full_queue_holds_the_source_back_and_drops_nothing(bounds: dict[str, int]) -> None:
    held = threading.Event()
    queue = Intake[str](bounds.get("messages", 99), bounds.get("size", 999), 1, held.set)
    source = threading.Thread(target=lambda: [queue.put(key("a"), bytes(10)) for _ in range(7)])
    source.start()
    assert held.wait(10)
    assert queue.depth == 2
    assert source.is_alive()
    taken = 0
    while taken < 7:
        queue.wait(1.0)
        batch = queue.take(1)
        assert queue.depth <= 2
        taken += len(batch)
    source.join(10)
    assert not source.is_alive()


def test_one_message_larger_than_the_bound_still_passes() -> None:
    queue = intake(size=20)
    assert queue.put(key("a"), bytes(50))
    assert len(queue.take(1)) == 1


def test_too_many_questions_are_turned_away_until_one_is_answered() -> None:
    queue = intake(queries=2)
    assert [queue.ask("x") for _ in range(3)] == [True, True, False]
    queue.take_queries()
    assert not queue.ask("x")
    queue.answered()
    assert queue.ask("x")


def test_too_large_questions_are_turned_away() -> None:
    queue = intake(size=100)
    assert [queue.ask("x", 60), queue.ask("y", 60), queue.ask("z", 40)] == [True, False, True]
    queue.answered(60)
    assert queue.ask("y", 60)


def test_closing_lets_a_held_source_go() -> None:
    queue, results = intake(messages=1), []
    queue.put(key("a"), b"x")
    source = threading.Thread(target=lambda: results.append(queue.put(key("a"), b"y")))
    source.start()
    queue.close()
    source.join(10)
    assert results == [False]
    assert not queue.ask("x")


def test_strangers_come_as_soon_as_the_last_question_is_answered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shares, "_LONELY", 1e6)
    queue: Intake[str] = Intake(100, 10_000, 3, known=lambda lane: lane == "a")
    queue.put(key("a"), b"x")
    queue.put(key("nobody"), b"y")
    assert names(queue.take(9)) == [b"x", b"y"]
    queue.put(key("nobody"), b"z")
    assert queue.ask("question")
    queue.take_queries()
    queue.wait(0.01)
    assert queue.take(9) == []
    answering, start = threading.Timer(0.01, queue.answered), time.monotonic()
    answering.start()
    queue.wait(60.0)
    assert time.monotonic() - start < 50.0, "it is woken"
    assert names(queue.take(9)) == [b"z"]
    answering.join()
