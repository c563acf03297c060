"""Questions to logs over a real Zenoh session: how many are under way at once."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import pytest
import zenoh
from integration.loopback import wait_until

from koop_protocol import ReplayQuery, replay_key
from koop_service.serving.admission.news import LogAnswer, LogQuestion
from koop_service.serving.config import NetworkSettings
from koop_service.serving.replay.catchup import ANSWERS, room_of
from koop_service.serving.replay.log_reader import LogReader
from koop_service.serving.session import open_session

NAME = "cart/0"


@contextmanager
def asked(count: int, room: int) -> Iterator[tuple[list[zenoh.Query], queue.Queue[LogAnswer]]]:
    """So many questions were put; those that have come, and the answers that are there."""
    questions: list[zenoh.Query] = []
    answers: queue.Queue[LogAnswer] = queue.Queue()
    with open_session(NetworkSettings(listen=("tcp/127.0.0.1:0",))) as session:
        callback = zenoh.handlers.Callback(questions.append, indirect=False)
        session.declare_queryable(replay_key(NAME), callback)
        reader = LogReader(session, answers.put, 1 << 20)
        reader.start()
        for number in range(count):
            reader.ask(LogQuestion(number, NAME, ReplayQuery(max_bytes=room)))
        yield questions, answers
        reader.stop(10.0)


@pytest.mark.parametrize("behind", [1, 1000])
def test_what_is_under_way_is_bounded_by_what_may_come_back(behind: int) -> None:
    room = room_of(behind)
    most, count = ANSWERS // room, ANSWERS // room + 20
    with asked(count, room) as (questions, answers):
        wait_until(lambda: len(questions) == most)
        for number in range(count):
            wait_until(partial(_holds, questions, number))
            assert len(questions) - number <= most
            with questions[number] as query:
                query.reply(replay_key(NAME), b"x")
            answer = answers.get(timeout=30.0)
            assert (answer.question.number, answer.payload) == (number, b"x")


def _holds(questions: list[zenoh.Query], number: int) -> bool:
    return len(questions) > number


def test_few_are_asked_for_much_and_many_for_little() -> None:
    rooms = [room_of(behind) for behind in range(2000)]
    assert rooms == sorted(rooms, reverse=True)
    assert (rooms[0], rooms[-1]) == (1 << 18, 1 << 15)
