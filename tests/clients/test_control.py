"""Commands over real Zenoh: newest first, the rest of the last plan, and every end of a task."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import zenoh

from koop_clients.connection import open_session
from koop_clients.control import Controller
from koop_clients.queries import KoopError
from koop_protocol import (
    Command,
    EndReason,
    ErrorCode,
    ErrorReply,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    Message,
    ProtocolError,
    client_token,
    command_key,
    decode,
    encode,
)

EPOCH = "0123456789abcdef"
QUERY = LqrQuery(3, target_code=np.zeros(8))
WAIT = 5.0  # s; a test that meets it has failed


def plan(seq: int, *torques: float, start: int | None = None) -> LqrReply:
    rows = np.array(torques)[:, None]
    return LqrReply(
        "a", EPOCH, seq, "solved", 0.0, 0.0, rows, start=seq if start is None else start
    )


class Service:
    """Answers what it is told to, and puts commands by hand."""

    def __init__(self, hub: zenoh.Session) -> None:
        self.seen: list[Message] = []
        self.answers: list[LqrReply | ErrorReply] = [plan(10, 1.0, 2.0, 3.0)]
        self.tokens: set[str] = set()
        self.changed = threading.Condition()
        self._hub = hub
        self._declared = [
            hub.declare_queryable("koop/lqr/*", self._answer),
            hub.liveliness().declare_subscriber("koop/@client/*", self._on_token, history=True),
        ]

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            message = decode(bytes(query.payload or b""))
            self.seen.append(message)
            if isinstance(message, LqrCancel):
                reply = LqrEnd("a", message.owner, EndReason.cancelled, "cancelled by its owner")
            else:
                reply = self.answers[0] if len(self.answers) == 1 else self.answers.pop(0)
            if isinstance(reply, ErrorReply):
                query.reply_err(encode(reply))
            else:
                query.reply(query.key_expr, encode(reply))

    def _on_token(self, sample: zenoh.Sample) -> None:
        with self.changed:
            there = sample.kind == zenoh.SampleKind.PUT
            (self.tokens.add if there else self.tokens.discard)(str(sample.key_expr))
            self.changed.notify_all()

    def command(self, controller: Controller, seq: int, *torques: float, delay: int = 0) -> None:
        rows = np.array(torques)[:, None]
        who = ("a", EPOCH, seq, seq + delay)
        self.put(Command(*who, rows, "solved", 1.0, 0.0, controller.owner))

    def put(self, message: Command | LqrEnd) -> None:
        self._hub.put(command_key("a"), encode(message))

    def wait_for_token(self, owner: str, there: bool) -> bool:
        with self.changed:
            return self.changed.wait_for(
                lambda: (client_token(owner) in self.tokens) == there, timeout=WAIT
            )


@pytest.fixture
def service(hub: zenoh.Session) -> Service:
    return Service(hub)


@pytest.fixture
def session(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(endpoint) as opened:
        yield opened


@pytest.fixture
def controller(service: Service, session: zenoh.Session) -> Iterator[Controller]:
    del service
    with Controller(session, "a", QUERY) as opened:
        yield opened


def torques(controller: Controller, *seqs: int, newest: int | None = None) -> list[float | None]:
    rows = [controller.control(seq, newest) for seq in seqs]
    return [None if row is None else float(row[0]) for row in rows]


def test_the_first_plan_is_followed(controller: Controller, service: Service) -> None:
    assert torques(controller, 10) == [None]
    reply = controller.begin()
    assert reply.fit
    assert torques(controller, 9, 10, 11, 12, 13) == [None, 1.0, 2.0, 3.0, None]
    (task,) = service.seen
    assert isinstance(task, LqrTask)
    assert (task.owner, task.seconds, task.frozen) == (controller.owner, None, False)


def test_the_newest_command_has_the_word_and_the_last_one_its_rest(
    controller: Controller, service: Service
) -> None:
    controller.begin()
    service.command(controller, 11, 20.0, 30.0, 40.0)
    assert controller.wait(11, WAIT)
    assert torques(controller, 10, 11, 12, 13, 14) == [1.0, 20.0, 30.0, 40.0, None]
    service.command(controller, 14, 50.0)
    assert controller.wait(14, WAIT)
    assert torques(controller, 13, 14, 15) == [40.0, 50.0, None]
    assert controller.command is not None
    assert controller.command.seq == 14


def test_with_a_delay_the_older_command_speaks_of_the_time_between(
    controller: Controller, service: Service
) -> None:
    service.answers = [plan(10, 1.0, 2.0, 3.0, start=12)]
    controller.begin()
    service.command(controller, 11, 20.0, 30.0, 40.0, delay=2)
    assert controller.wait(11, WAIT)
    assert torques(controller, 11, 12, 13, 14) == [None, 1.0, 20.0, 30.0]


def test_what_came_later_can_be_left_out(controller: Controller, service: Service) -> None:
    controller.begin()
    service.command(controller, 11, 20.0, 30.0, 40.0)
    assert controller.wait(11, WAIT)
    assert torques(controller, 11, 12, newest=10) == [2.0, 3.0]
    assert torques(controller, 11, 12, newest=11) == [20.0, 30.0]
    assert torques(controller, 11, newest=9) == [None]


def test_a_wait_ends_with_the_command_or_its_time(controller: Controller, service: Service) -> None:
    controller.begin()
    assert controller.wait(9, 0.0)
    assert not controller.wait(11, 0.05)
    assert controller.arrived(11) is None
    before = time.monotonic()
    threading.Timer(0.1, service.command, (controller, 12, 5.0)).start()
    assert controller.wait(11, WAIT)  # a later one does as well
    came = controller.arrived(12)
    assert came is not None
    assert before + 0.1 <= came <= time.monotonic()
    assert controller.arrived(11) is None


def test_the_commands_of_others_and_nonsense_are_passed_over(
    controller: Controller, service: Service, hub: zenoh.Session
) -> None:
    controller.begin()
    service.put(Command("a", EPOCH, 11, 11, np.ones((3, 1)), "solved", 1.0, 0.0, "somebody"))
    service.put(LqrEnd("a", "somebody", EndReason.expired, "its time is over"))
    hub.put(command_key("a"), b"nonsense")
    service.command(controller, 12, 7.0)
    assert controller.wait(12, WAIT)
    assert controller.arrived(11) is None
    assert controller.ended is None
    assert torques(controller, 11) == [2.0]


def test_the_end_is_told_and_nobody_waits_for_more(
    controller: Controller, service: Service
) -> None:
    controller.begin()
    end = LqrEnd("a", controller.owner, EndReason.expired, "its 5 s are over")
    threading.Timer(0.1, service.put, (end,)).start()
    assert not controller.wait(11, WAIT)
    assert controller.ended == end
    assert torques(controller, 11) == [2.0]  # the rest of the last plan
    controller.begin()
    assert controller.ended is None


def test_a_model_that_is_not_fit_begins_nothing(controller: Controller, service: Service) -> None:
    unfit = LqrReply("a", EPOCH, 10, "unfit", 0.0, 0.0, fit=False, reasons=("no excitation",))
    service.answers = [unfit]
    assert controller.begin().reasons == ("no excitation",)
    assert torques(controller, 10) == [None]
    controller.close()
    controller.close()
    assert not any(isinstance(message, LqrCancel) for message in service.seen)


def test_a_refusal_names_the_other_owner(controller: Controller, service: Service) -> None:
    taken = ErrorReply(ErrorCode.task_taken, "line3 drives it", {"owner": "line3"})
    service.answers = [taken]
    with pytest.raises(KoopError, match="line3 drives it") as caught:
        controller.begin()
    assert caught.value.details == {"owner": "line3"}


def test_a_token_that_travels_longer_than_the_question_is_waited_for(
    controller: Controller, service: Service
) -> None:
    early = ErrorReply(ErrorCode.no_owner, "declare koop/@client/x first")
    service.answers = [early, early, plan(10, 1.0)]
    assert controller.begin().fit
    assert len(service.seen) == 3


def test_another_task_replaces_the_first(controller: Controller, service: Service) -> None:
    controller.begin()
    service.command(controller, 11, 20.0, 30.0)
    assert controller.wait(11, WAIT)
    service.answers = [plan(11, -1.0, -2.0)]
    controller.change(LqrQuery(2, target_code=np.ones(8), delay=3))
    assert torques(controller, 11, 12) == [-1.0, -2.0]
    task = service.seen[-1]
    assert isinstance(task, LqrTask)
    assert (task.owner, task.query.delay) == (controller.owner, 3)


def test_a_source_that_starts_anew_has_other_numbers(
    controller: Controller, service: Service
) -> None:
    controller.begin()
    fresh = Command("a", "f" * 16, 3, 3, np.ones((1, 1)), "solved", 1.0, 0.0, controller.owner)
    service.put(fresh)
    deadline = time.monotonic() + WAIT
    while torques(controller, 3) == [None] and time.monotonic() < deadline:
        time.sleep(0.01)
    assert torques(controller, 3, 10) == [1.0, None]


def test_the_token_lives_as_long_as_the_controller(
    service: Service, session: zenoh.Session
) -> None:
    with Controller(session, "a", QUERY, owner="line3.robot-7", seconds=9.0, frozen=True) as opened:
        assert service.wait_for_token("line3.robot-7", there=True)
        opened.begin()
    assert service.wait_for_token("line3.robot-7", there=False)
    task, cancel = service.seen
    assert isinstance(task, LqrTask)
    assert (task.owner, task.seconds, task.frozen) == ("line3.robot-7", 9.0, True)
    assert isinstance(cancel, LqrCancel)


def test_two_controllers_have_names_of_their_own(session: zenoh.Session) -> None:
    with Controller(session, "a", QUERY) as first, Controller(session, "a", QUERY) as second:
        assert first.owner != second.owner


@pytest.mark.parametrize(
    "make",
    [
        lambda session: Controller(session, "not a name", QUERY),
        lambda session: Controller(session, "a", QUERY, owner="not a name"),
        lambda session: Controller(session, "a", QUERY, seconds=-1.0),
        lambda session: Controller(
            session, "a", LqrQuery(3, target_code=np.zeros(8), returns=frozenset({"codes"}))
        ),
    ],
)
def test_what_breaks_the_protocol_is_not_declared(
    session: zenoh.Session, make: Callable[[zenoh.Session], Controller]
) -> None:
    with pytest.raises(ProtocolError):
        make(session)
