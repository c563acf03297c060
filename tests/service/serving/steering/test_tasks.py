"""Tasks without a network: begun, carried on, ended."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from koop_protocol import Command, EndReason, ErrorCode, LqrQuery, LqrTask, ProtocolError
from koop_service.prediction.model import LinearModel
from koop_service.serving.steering.tasks import Tasks

from .linear import N, Plant, registry_of

BOUND = 3.0 * np.ones(1)


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def tasks(clock: Clock) -> Tasks:
    tasks = Tasks(clock)
    tasks.welcome("me")
    tasks.welcome("you")
    return tasks


@pytest.fixture
def plant(tmp_path: Path) -> Plant:
    return Plant(registry_of(tmp_path)).excite()


def order(owner: str = "me", seconds: float | None = None, frozen: bool = False, **changes):
    options = {"horizon": 15, "target_code": np.zeros(N), "r": 0.1, "u_min": -BOUND, "u_max": BOUND}
    return LqrTask(owner, LqrQuery(**{**options, **changes}), seconds, frozen)


def drive(tasks: Tasks, plant: Plant, frames: int) -> list[Command]:
    commands = []
    for _ in range(frames):
        command = tasks.command(plant.trajectory)
        assert isinstance(command, Command)
        commands.append(command)
        plant.step(command.controls[0])
    return commands


@pytest.mark.parametrize("method", ["qp", "gain"])
def test_commands_bring_the_plant_to_its_target(tasks, plant, method):
    rest = np.linalg.solve(np.eye(N) - plant.A, plant.B @ np.array([0.05]))
    plant.code = plant.code + 0.5
    plant.show()
    options = {"target_code": rest, "r": 1e-4, "qf": "riccati", "method": method}
    reply = tasks.begin(plant.trajectory, order(**options))
    assert reply.fit
    commands = drive(tasks, plant, 80)
    assert {command.status for command in commands} == {"solved"}
    assert [command.seq for command in commands] == list(range(reply.seq, reply.seq + 80))
    np.testing.assert_allclose(plant.code, rest, atol=0.05)


def test_a_delayed_task_says_for_which_interval_a_command_is(tasks, plant):
    tasks.begin(plant.trajectory, order(delay=2))
    command = tasks.command(plant.trajectory)
    assert (command.owner, command.epoch) == ("me", plant.epoch)
    assert command.start == command.seq + 2 == plant.seq + 2


def test_no_task_begins_without_its_owners_token(tasks, plant):
    with pytest.raises(ProtocolError, match="koop/@client/nobody") as caught:
        tasks.begin(plant.trajectory, order("nobody"))
    assert caught.value.code == ErrorCode.no_owner
    assert len(tasks) == 0
    assert tasks.command(plant.trajectory) is None


def test_a_second_owner_is_refused_with_the_first_ones_name(tasks, plant):
    tasks.begin(plant.trajectory, order())
    for claim in (
        lambda: tasks.begin(plant.trajectory, order("you")),
        lambda: tasks.cancel(plant.trajectory.name, "you"),
    ):
        with pytest.raises(ProtocolError) as caught:
            claim()
        assert caught.value.code == ErrorCode.task_taken
        assert caught.value.details == {"owner": "me", "trajectory": "cart/0"}
    tasks.bid_farewell("me")
    assert tasks.begin(plant.trajectory, order("you")).fit


def test_its_owner_may_change_a_task_and_what_was_promised_stays(tasks, plant):
    rate = np.array([0.2])
    tasks.begin(plant.trajectory, order(du_min=-rate, du_max=rate, delay=2))
    drive(tasks, plant, 3)
    last = tasks.command(plant.trajectory)
    far = order(target_code=np.ones(N), du_min=-rate, du_max=rate, delay=3)
    first = tasks.begin(plant.trajectory, far)
    assert len(tasks) == 1
    assert abs(first.controls[0, 0] - last.controls[0, 0]) <= 0.2 + 1e-12
    assert first.start == last.start + 1


def test_an_unfit_model_begins_no_task_and_leaves_a_former_one(tasks, tmp_path):
    plant = Plant(registry_of(tmp_path))
    for _ in range(80):
        plant.step(np.zeros(1))
    assert not tasks.begin(plant.trajectory, order()).fit
    assert len(tasks) == 0
    assert not tasks.begin(plant.trajectory, order(force=True)).fit
    task = tasks.find("cart/0")
    tasks.begin(plant.trajectory, order())
    assert tasks.find("cart/0") is task is not None


def test_a_task_is_cancelled_once(tasks, plant):
    tasks.begin(plant.trajectory, order())
    end = tasks.cancel("cart/0", "me")
    assert (end.trajectory, end.owner, end.reason) == ("cart/0", "me", EndReason.cancelled)
    with pytest.raises(ProtocolError) as caught:
        tasks.cancel("cart/0", "me")
    assert caught.value.code == ErrorCode.no_task
    assert tasks.command(plant.trajectory) is None


def test_a_task_ends_by_itself_when_its_time_is_over(tasks, plant, clock):
    tasks.begin(plant.trajectory, order(seconds=5.0))
    clock.now += 4.9
    assert tasks.expire() == []
    clock.now += 0.1
    assert [end.reason for end in tasks.expire()] == [EndReason.expired]
    assert tasks.expire() == []
    tasks.begin(plant.trajectory, order())
    clock.now += 1e9
    assert tasks.expire() == []


def test_an_owner_that_is_gone_takes_its_tasks_along_and_no_others(tasks, tmp_path):
    registry = registry_of(tmp_path)
    plants = [Plant(registry, f"cart/{i}", seed=i).excite() for i in range(3)]
    for plant, owner in zip(plants, ("me", "you", "me"), strict=True):
        tasks.begin(plant.trajectory, order(owner))
    ends = tasks.bid_farewell("me")
    assert [(end.trajectory, end.reason) for end in ends] == [
        ("cart/0", EndReason.owner_gone),
        ("cart/2", EndReason.owner_gone),
    ]
    assert isinstance(tasks.command(plants[1].trajectory), Command)
    with pytest.raises(ProtocolError, match="liveliness"):
        tasks.begin(plants[0].trajectory, order())


def test_a_new_epoch_ends_the_task(tasks, plant):
    tasks.begin(plant.trajectory, order())
    plant.epoch, plant.seq = "f" * 16, -1
    plant.show()
    assert tasks.command(plant.trajectory).reason == EndReason.replaced_epoch
    assert tasks.command(plant.trajectory) is None


def test_a_trajectory_that_is_not_held_and_a_shutdown_end_tasks(tasks, plant):
    tasks.begin(plant.trajectory, order())
    assert tasks.evict({"cart/0"}) == []
    assert [end.reason for end in tasks.evict(set())] == [EndReason.evicted]
    tasks.begin(plant.trajectory, order())
    assert [end.reason for end in tasks.shut_down()] == [EndReason.shutdown]
    assert len(tasks) == 0


def test_without_a_plan_the_command_is_the_rest_of_the_last_one(tasks, plant):
    tasks.begin(plant.trajectory, order())
    (last,) = drive(tasks, plant, 1)
    model = plant.trajectory.model()
    plant.trajectory.model = lambda: LinearModel(1e200 * model.A, model.B, model.c)
    plant.excite(2)
    command = tasks.command(plant.trajectory)
    assert (command.status, command.cost, command.kkt_residual) == ("failed", 0.0, 0.0)
    assert command.seq == last.seq + 3
    rest = np.concatenate([last.controls[3:], np.tile(last.controls[-1], (3, 1))])
    np.testing.assert_array_equal(command.controls, rest)
    del plant.trajectory.model
    assert tasks.command(plant.trajectory).status == "solved"


def test_a_frozen_task_keeps_the_model_of_its_registration(tasks, plant):
    tasks.begin(plant.trajectory, order(frozen=True))
    model = tasks.find("cart/0").frozen
    plant.B = 3.0 * plant.B
    drive(tasks, plant, 10)
    assert tasks.find("cart/0").frozen is model
    command = tasks.command(plant.trajectory)
    tasks.begin(plant.trajectory, order(force=True))  # the change makes the model doubtful
    assert tasks.find("cart/0").frozen is None
    learned = tasks.command(plant.trajectory)
    assert not np.allclose(learned.controls, command.controls, rtol=1e-3)


def test_a_task_may_not_plan_as_far_as_a_single_question(tasks, plant):
    with pytest.raises(ProtocolError, match="expected at most 100 steps") as caught:
        tasks.begin(plant.trajectory, order(horizon=101))
    assert caught.value.code == ErrorCode.bad_horizon
    assert len(tasks) == 0
