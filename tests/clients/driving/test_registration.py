"""Asking until the service grants the task, and when to stop asking."""

from __future__ import annotations

from concurrent.futures import Executor, Future
from typing import Any

import numpy as np
import pytest

from koop_clients.queries import NO_REPLY, KoopError
from koop_clients.sim_client.driving.registration import Registration
from koop_protocol import ErrorCode, LqrReply

EPOCH = "0" * 16


class AtOnce(Executor):
    """Runs what it is given right away; `slow` keeps it until `finish`."""

    def __init__(self) -> None:
        self.slow = False
        self.kept: list[tuple[Future[Any], Any]] = []

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        del args, kwargs
        future: Future[Any] = Future()
        self.kept.append((future, fn))
        if not self.slow:
            self.finish()
        return future

    def finish(self) -> None:
        for future, work in self.kept:
            try:
                future.set_result(work())
            except KoopError as error:
                future.set_exception(error)
        self.kept.clear()


def granted() -> LqrReply:
    return LqrReply("a", EPOCH, 5, "solved", 1.0, 0.0, np.ones((3, 1)))


def unfit() -> LqrReply:
    return LqrReply("a", EPOCH, 5, "unfit", 0.0, 0.0, fit=False, reasons=("too little torque",))


def refused(code: str) -> LqrReply:
    raise KoopError(code, f"because of {code}")


@pytest.fixture
def executor() -> AtOnce:
    return AtOnce()


@pytest.fixture
def registration(executor: AtOnce) -> Registration:
    return Registration(executor, "a", EPOCH)


def test_it_does_not_wait(registration: Registration, executor: AtOnce) -> None:
    executor.slow = True
    registration.ask(granted)
    registration.ask(granted)
    assert len(executor.kept) == 1
    registration.settle(5, wait=False)
    assert registration.reply is None
    executor.finish()
    registration.settle(6, wait=False)
    assert registration.reply is not None
    registration.ask(granted)
    assert not executor.kept


def test_a_model_that_becomes_fit_is_waited_for(registration: Registration) -> None:
    for number in range(100, 300):
        registration.ask(unfit)
        registration.settle(number, wait=True)
    assert (registration.reasons, registration.has_given_up) == (("too little torque",), False)
    assert registration.standing == "not fit for control yet"
    registration.ask(granted)
    registration.settle(300, wait=True)
    assert registration.reply is not None
    assert registration.standing == ""


def test_a_model_that_does_not_is_given_up_after_ten_seconds(
    registration: Registration, executor: AtOnce
) -> None:
    for number in range(100, 301):
        assert not registration.has_given_up
        registration.ask(unfit)
        registration.settle(number, wait=True)
    assert registration.has_given_up
    executor.slow = True
    registration.ask(granted)
    assert not executor.kept


@pytest.mark.parametrize("code", [NO_REPLY, ErrorCode.warming_up, ErrorCode.overloaded])
def test_what_passes_is_asked_again(registration: Registration, code: str) -> None:
    registration.ask(lambda: refused(code))
    registration.settle(5, wait=True)
    assert registration.standing
    registration.ask(granted)
    registration.settle(6, wait=True)
    assert registration.reply is not None


@pytest.mark.parametrize("code", [ErrorCode.task_taken, ErrorCode.bad_target, ErrorCode.no_owner])
def test_what_lasts_is_raised(registration: Registration, code: str) -> None:
    registration.ask(lambda: refused(code))
    with pytest.raises(KoopError, match=f"because of {code}"):
        registration.settle(5, wait=True)


def test_a_lost_task_is_asked_for_again(registration: Registration) -> None:
    registration.ask(granted)
    registration.settle(5, wait=True)
    registration.lose("the service stopped")
    assert (registration.reply, registration.standing) == (None, "the service stopped")
    registration.ask(granted)
    registration.settle(6, wait=True)
    assert registration.reply is not None


def test_a_plan_for_somebody_else_s_stream_is_no_plan(executor: AtOnce) -> None:
    registration = Registration(executor, "a", "f" * 16)
    registration.ask(granted)
    with pytest.raises(KoopError, match="another source streams as a"):
        registration.settle(5, wait=True)
