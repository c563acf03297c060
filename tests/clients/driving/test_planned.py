"""One plan, followed to its end without a further look."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor

import numpy as np
import pytest

from koop_clients.mechanics.simulation import State
from koop_clients.sim_client.driving.planned import Planned
from koop_clients.sim_client.driving.registration import Registration
from koop_protocol import LqrReply

EPOCH, TAKEOVER = "0" * 16, 10
STATE = State(np.zeros(1), np.zeros(1))


@pytest.fixture
def executor() -> Iterator[Executor]:
    with ThreadPoolExecutor(1) as pool:
        yield pool


class Service:
    """Answers with a plan of three torques, once the model is fit."""

    def __init__(self, unfit: int = 0) -> None:
        self.asked, self.unfit, self.frame = 0, unfit, 0

    def plan(self) -> LqrReply:
        self.asked += 1
        who = ("a", EPOCH, self.frame)
        if self.asked <= self.unfit:
            return LqrReply(*who, "unfit", 0.0, 0.0, fit=False, reasons=("why",))
        controls, frames = np.array([[1.0], [2.0], [3.0]]), np.full((3, 4, 4), 7, np.uint8)
        return LqrReply(*who, "solved", 1.0, 0.0, controls, frames=frames, warnings=("hm",))


def follow(service: Service, executor: Executor, frames: int) -> tuple[Planned, list[float | None]]:
    """The torque of each interval, None where the driver does not speak."""
    driver = Planned(service.plan, Registration(executor, "a", EPOCH), TAKEOVER)
    torques: list[float | None] = []
    for number in range(frames):
        service.frame = number
        driver.shown(number)
        driver.settle(number)
        spoke = driver.speaks(number)
        torques.append(driver.torque(number, 3, STATE) if spoke else None)
    return driver, torques


def test_it_asks_once_and_follows_the_plan_to_its_end(executor: Executor) -> None:
    service = Service()
    driver, torques = follow(service, executor, 15)
    assert torques == [None] * 10 + [1.0, 2.0, 3.0] + [None] * 2
    assert driver.torque(14, 0, STATE) == 0.0
    assert service.asked == 1
    assert driver.pictures is not None
    assert driver.pictures.shape == (3, 4, 4)
    assert (driver.account.statuses, driver.account.warnings) == ({"solved": 1}, ("hm",))


def test_it_asks_again_while_the_model_is_not_fit(executor: Executor) -> None:
    service = Service(unfit=4)
    driver, torques = follow(service, executor, 18)
    assert torques == [None] * 14 + [1.0, 2.0, 3.0, None]
    assert driver.account.reasons == ("why",)
    assert not driver.has_given_up
