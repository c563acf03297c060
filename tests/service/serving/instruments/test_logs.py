"""Logs: one object a line for machines, and a brake for what happens at every frame."""

from __future__ import annotations

import json
import logging
import sys

from koop_protocol import ErrorCode, Limits, ProtocolError
from koop_service.serving.admission.arrivals import Arrival
from koop_service.serving.admission.reading import read
from koop_service.serving.instruments.logs import Brake, JsonFormatter, TextFormatter
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.trajectories.refusals import Refusals


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_brake_lets_one_of_a_kind_through_and_counts_the_rest() -> None:
    clock = Clock()
    brake = Brake(clock, every=10.0)
    assert brake.admit("a") == 0
    assert [brake.admit("a") for _ in range(5)] == [None] * 5
    assert brake.admit("b") == 0
    clock.now = 10.0
    assert brake.admit("a") == 5
    clock.now = 20.0
    assert brake.admit("a") == 0


def test_json_lines_carry_the_fields_and_the_traceback() -> None:
    try:
        raise RuntimeError("on fire")
    except RuntimeError:
        record = logging.makeLogRecord(
            {
                "msg": "it %s",
                "args": ("burns",),
                "levelname": "ERROR",
                "created": 0.25,
                "msecs": 250,
                "trajectory": "cart/0",
                "exc_info": __import__("sys").exc_info(),
            }
        )
    line = JsonFormatter().format(record)
    assert "\n" not in line
    entry = json.loads(line)
    assert entry["time"] == "1970-01-01T00:00:00.250Z"
    assert (entry["level"], entry["message"]) == ("error", "it burns")
    assert entry["trajectory"] == "cart/0"
    assert "RuntimeError: on fire" in entry["traceback"]


def test_text_lines_are_for_people() -> None:
    record = logging.makeLogRecord({"msg": "hello", "levelname": "INFO"})
    assert TextFormatter().format(record).endswith("INFO    hello")


def test_rejections_are_counted_all_logged_once_and_remembered(caplog) -> None:
    metrics = Metrics()
    refusals = Refusals(metrics, Brake(Clock()))
    for i in range(3000):
        refusals.note(f"cart/{i}", ProtocolError(ErrorCode.malformed, f"problem {i}"))
    assert metrics.value("koop_rejected_total", reason="malformed") == 3000
    assert len(caplog.records) == 1
    assert refusals.last("cart/2999").problem == "problem 2999"
    assert refusals.last("cart/0") is None, "memory must stay bounded"


def test_what_is_remembered_of_a_message_is_not_its_bytes() -> None:
    """A thousand messages of four megabytes, each rejected under another name, are four GB."""
    data, refusals = bytes(range(256)) * 100, Refusals(Metrics(), Brake(Clock()))
    held = sys.getrefcount(data)
    arrival = Arrival("koop/frame/00/cart/0", data, 0)
    try:
        read(arrival, Limits())
    except ProtocolError as error:
        refusals.note("cart/0", error)
    del arrival
    assert sys.getrefcount(data) == held
    assert refusals.last("cart/0") is not None
