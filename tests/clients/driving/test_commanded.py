"""Which command acts when: in real time, with a slow camera, and where time waits."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest

from koop_clients.control import Controller
from koop_clients.mechanics.simulation import FRAME_INTERVAL, STEPS_PER_FRAME, State
from koop_clients.queries import KoopError
from koop_clients.sim_client.driving import commanded as module
from koop_clients.sim_client.driving.commanded import Commanded
from koop_clients.sim_client.driving.registration import Registration
from koop_clients.sim_client.driving.timing import Timing
from koop_protocol import Command, EndReason, LqrEnd, LqrQuery, LqrReply

EPOCH = "0" * 16
STATE = State(np.zeros(1), np.zeros(1))
TAKEOVER = 10


class AtOnce(Executor):
    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        del args, kwargs
        future: Future[Any] = Future()
        try:
            future.set_result(fn())
        except KoopError as error:
            future.set_exception(error)
        return future


@dataclass
class Script:
    """Stands in for a controller: plan k says k, k + 0.1, ... and comes `lag` [s] after frame k."""

    lags: dict[int, float]
    clock: list[float]
    rows: int = 3
    delay: int = 0
    fit: bool = True
    asked: list[LqrQuery] = field(default_factory=list)
    waited: list[int] = field(default_factory=list)
    ended: LqrEnd | None = None
    command: Command | None = None
    closed: bool = False

    def begin(self) -> LqrReply:
        seq = round(self.clock[0] / FRAME_INTERVAL)
        if not self.fit:
            return LqrReply("a", EPOCH, seq, "unfit", 0.0, 0.0, fit=False, reasons=("why",))
        self.ended = None
        who = ("a", EPOCH, seq)
        return LqrReply(*who, "solved", 1.0, 0.0, np.ones((self.rows, 1)), warnings=("hm",))

    def arrived(self, seq: int) -> float | None:
        came = seq * FRAME_INTERVAL + self.lags.get(seq, 0.01)
        return came if seq >= 0 and came <= self.clock[0] else None

    def control(self, seq: int, newest: int) -> np.ndarray | None:
        for plan in range(newest, -1, -1):
            row = seq - plan - self.delay
            if not math.isinf(self.lags.get(plan, 0.01)) and 0 <= row < self.rows:
                return np.array([plan + 0.1 * row])
        return None

    def wait(self, seq: int, timeout: float) -> bool:
        self.waited.append(seq)
        came = seq * FRAME_INTERVAL + self.lags.get(seq, 0.01)
        self.clock[0] = max(self.clock[0], min(came, self.clock[0] + timeout))
        return came <= self.clock[0]

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


Make = Callable[..., tuple[Commanded, Script]]


@pytest.fixture
def make(clock: list[float]) -> Make:
    def build(
        timing: Timing | None = None, lags: dict[int, float] | None = None, **changes: Any
    ) -> tuple[Commanded, Script]:
        script = Script(lags or {}, clock, **changes)

        def open_controller(query: LqrQuery) -> Controller:
            script.asked.append(query)
            return cast(Controller, script)

        registration = Registration(AtOnce(), "a", EPOCH)
        query = LqrQuery(3, target_code=np.zeros(2))
        driver = Commanded(
            open_controller, query, registration, timing or Timing(1.0), TAKEOVER, lambda: 0.01
        )
        return driver, script

    return build


def follow(driver: Commanded, clock: list[float], frames: int) -> list[list[float]]:
    """The ten torques of each interval, as the live loop asks for them."""
    found = []
    for number in range(frames):
        clock[0] = number * FRAME_INTERVAL
        driver.shown(number)
        clock[0] += FRAME_INTERVAL - 1e-6
        driver.settle(number)
        steps = range(STEPS_PER_FRAME)
        found.append([round(driver.torque(number, step, STATE), 3) for step in steps])
    return found


def test_until_a_command_comes_the_older_plan_goes_on(make: Make, clock: list[float]) -> None:
    driver, _ = make()
    intervals = follow(driver, clock, 15)
    assert intervals[12] == [11.1] * 2 + [12.0] * 8
    assert driver.speaks(12)


def test_a_command_that_is_late_acts_when_it_is_there(make: Make, clock: list[float]) -> None:
    driver, _ = make(lags={12: 0.075, 13: 0.075})
    intervals = follow(driver, clock, 16)
    assert intervals[12] == [11.1] * 10
    assert intervals[13] == [11.2] * 5 + [12.1] * 5
    assert intervals[14] == [12.2] * 2 + [14.0] * 8
    assert driver.account.late == 2


def test_commands_that_never_come_leave_the_rest_of_the_plan_and_then_nothing(
    make: Make, clock: list[float]
) -> None:
    lost = dict.fromkeys(range(12, 40), math.inf)
    driver, _ = make(lags=lost)
    intervals = follow(driver, clock, 16)
    assert intervals[12] == [11.1] * 10
    assert intervals[13] == [11.2] * 10
    assert intervals[14] == [0.0] * 10
    assert not driver.speaks(14)
    assert driver.account.late == 4


def test_one_lost_command_is_no_silence(make: Make, clock: list[float]) -> None:
    driver, script = make(Timing(math.inf), lags={12: math.inf})
    follow(driver, clock, 13)
    assert (driver.standing, driver.account.late) == ("", 1)
    assert len(script.asked) == 1


def test_it_asks_just_before_the_drive_and_measures_its_delay(
    make: Make, clock: list[float]
) -> None:
    driver, script = make()
    follow(driver, clock, TAKEOVER - 1)
    assert script.asked == []
    follow(driver, clock, TAKEOVER + 1)
    assert [query.delay for query in script.asked] == [0]
    slow, script = make(Timing(1.0, 0.1))
    follow(slow, clock, TAKEOVER)
    assert [query.delay for query in script.asked] == [2]
    assert slow.account.delay == 2


def test_a_slow_camera_s_commands_act_on_what_is_left_of_the_future(
    make: Make, clock: list[float]
) -> None:
    """Frames 0.1 s late and commands after 10 ms: two frames until a control can act."""
    driver, _ = make(Timing(1.0, 0.1), delay=2)
    intervals = follow(driver, clock, 20)
    assert intervals[16] == [13.1] * 2 + [14.0] * 8


def test_where_time_waits_every_command_acts_from_its_frame_on(
    make: Make, clock: list[float]
) -> None:
    driver, script = make(Timing(math.inf), lags={12: 0.4})
    intervals = follow(driver, clock, 14)
    assert intervals[12] == [12.0] * 10
    assert script.waited == [9, 10, 11, 12, 13]


def test_latencies_are_those_from_frame_to_command(make: Make, clock: list[float]) -> None:
    driver, _ = make(lags={11: 0.03, 12: 0.07})
    follow(driver, clock, 15)
    assert list(driver.account.latencies) == pytest.approx([0.01, 0.03, 0.07, 0.01, 0.01])
    assert driver.account.warnings == ("hm",)


def test_a_model_that_is_not_fit_says_nothing(make: Make, clock: list[float]) -> None:
    driver, script = make(fit=False)
    follow(driver, clock, 12)
    assert not driver.has_given_up
    assert driver.account.reasons == ("why",)
    assert driver.standing == "not fit for control yet"
    follow(driver, clock, 300)
    assert driver.has_given_up
    driver.close()
    assert script.closed


def test_a_task_that_ended_is_begun_again(make: Make, clock: list[float]) -> None:
    driver, script = make()
    follow(driver, clock, 12)
    script.ended = LqrEnd("a", "me", EndReason.shutdown, "the service stops")
    driver.settle(11)
    assert driver.standing == "the service stops"
    driver.shown(12)
    assert script.ended is None
    driver.settle(12)
    assert driver.standing == ""


def test_a_silent_service_is_asked_again_until_patience_ends(
    make: Make, clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("koop_clients.sim_client.patience.time.monotonic", lambda: clock[0])
    driver, script = make(lags=dict.fromkeys(range(12, 1000), math.inf))
    follow(driver, clock, 33)
    assert driver.standing == "no command for a second"

    def silence() -> LqrReply:
        raise KoopError("no_reply", "nobody answered")

    monkeypatch.setattr(script, "begin", silence)
    with pytest.raises(KoopError, match="nobody answered"):
        follow(driver, clock, 500)
    assert clock[0] > 10.0
