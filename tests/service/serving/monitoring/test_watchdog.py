"""A pipeline that stands still, as the watchdog sees it."""

from __future__ import annotations

from koop_service.serving.monitoring.watchdog import Watchdog, stacks


class Pipeline:
    turns = 0


def watched() -> tuple[Pipeline, Watchdog, list[str]]:
    pipeline, told = Pipeline(), []
    return pipeline, Watchdog(lambda: pipeline.turns, 60.0, told.append, False), told


def test_ten_looks_without_a_turn_are_told_once() -> None:
    pipeline, watchdog, told = watched()
    for _ in range(9):
        watchdog.look()
    assert not told
    for _ in range(30):
        watchdog.look()
    assert len(told) == 1
    pipeline.turns += 1
    for _ in range(11):
        watchdog.look()
    assert len(told) == 2


def test_a_turn_between_the_looks_is_enough() -> None:
    pipeline, watchdog, told = watched()
    for look in range(100):
        pipeline.turns += look % 10 == 9
        watchdog.look()
    assert not told


def test_the_stacks_say_who_stands_where() -> None:
    assert "test_the_stacks_say_who_stands_where" in stacks()
