"""The log of a training: averages, and a resumed run that goes on with it."""

import csv

import pytest
import torch

from koop_service.learning.hardware import choose
from koop_service.learning.log import EVERY, Log
from koop_service.learning.objective import Loss
from koop_service.learning.train import Setting, begin

from .blobs import smoke


def step_on(log: Log, training, steps: int, reconstruction: float) -> None:
    for _ in range(steps):
        training.step += 1
        training.frames += 10
        training.seconds += 0.1
        log(training, Loss(torch.zeros(()), 10, reconstruction))


def rows(path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def setting(recording) -> Setting:
    return Setting(recording, smoke(3 * EVERY, 1), 0, choose("cpu"))


def test_a_row_averages_the_steps_since_the_last_one(setting, tmp_path):
    path, training = tmp_path / "a.csv", begin(setting, "fitted")
    log = Log(path, setting, training)
    step_on(log, training, EVERY // 2, 0.2)
    step_on(log, training, EVERY - EVERY // 2, 0.4)
    step_on(log, training, EVERY, 0.1)
    first, second = rows(path)
    assert float(first["reconstruction"]) == pytest.approx(0.3)
    assert float(second["reconstruction"]) == pytest.approx(0.1)
    assert int(second["step"]) == 2 * EVERY
    assert float(second["rate"]) == pytest.approx(100, rel=0.01)


def test_a_resumed_run_drops_the_rows_after_its_checkpoint(setting, tmp_path):
    path, training = tmp_path / "a.csv", begin(setting, "fitted")
    step_on(Log(path, setting, training), training, 3 * EVERY, 0.5)
    resumed = begin(setting, "fitted")
    resumed.step, resumed.frames, resumed.seconds = EVERY + 7, 10 * EVERY, 1.0
    log = Log(path, setting, resumed)
    assert [int(row["step"]) for row in rows(path)] == [EVERY]
    step_on(log, resumed, EVERY - 7, 0.7)
    assert [int(row["step"]) for row in rows(path)] == [EVERY, 2 * EVERY]


def test_a_fresh_run_starts_a_new_log(setting, tmp_path):
    path, training = tmp_path / "a.csv", begin(setting, "fitted")
    step_on(Log(path, setting, training), training, EVERY, 0.5)
    Log(path, setting, begin(setting, "fitted"))
    assert rows(path) == []
