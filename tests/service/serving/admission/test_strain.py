"""When there is too much: two lines in the log an overload, and no flapping."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koop_protocol import OVERLOADED, ErrorCode
from koop_service.serving.admission.strain import MEMORY, QUEUE, Strain
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.instruments.process import own_bytes
from koop_service.serving.monitoring.memory import Memory


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def lines(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> pytest.LogCaptureFixture:
    monkeypatch.setattr(logging.getLogger("koop"), "propagate", True)
    caplog.set_level(logging.INFO, "koop.overload")
    return caplog


def test_an_overload_is_two_lines_whatever_is_refused(
    lines: pytest.LogCaptureFixture,
) -> None:
    clock, metrics = Clock(), Metrics()
    strain = Strain(QUEUE, metrics, clock)
    strain.observe(0.49)
    assert not strain.active
    strain.observe(0.5)
    assert strain.active
    for _ in range(7):
        error = strain.refuse()
    assert (error.code, error.details["reason"]) == (ErrorCode.overloaded, OVERLOADED)
    assert error.details["retry_after"] > 0
    strain.observe(0.1)
    clock.now = 1.0
    strain.observe(0.1)
    assert not strain.active
    assert [record.levelname for record in lines.records] == ["WARNING", "INFO"]
    assert "after 1.0 s" in lines.records[1].getMessage()
    assert "7 requests were refused" in lines.records[1].getMessage()
    assert metrics.value("koop_shed_total", reason=OVERLOADED) == 7


@given(st.lists(st.tuples(st.floats(0, 2), st.floats(0, 0.9)), max_size=40))
def test_it_is_over_only_after_a_while_well_below(steps: list) -> None:
    """Levels, and times in between."""
    clock, bounds = Clock(), QUEUE.bounds
    strain, calm = Strain(QUEUE, Metrics(), clock), None
    for level, wait in steps:
        clock.now += wait
        before = strain.active
        calm = None if level >= bounds.end else clock.now if calm is None else calm
        strain.observe(level)
        if before and not strain.active:
            assert calm is not None
            assert clock.now - calm >= bounds.calm
        assert strain.active or level < bounds.begin


def test_memory_is_looked_at_now_and_then() -> None:
    clock, read = Clock(), []
    strain = Strain(MEMORY, Metrics(), clock)
    memory = Memory(100, strain, lambda: read.append(1) or 100, clock)
    for _ in range(10):
        memory.observe()
    assert len(read) == 1
    assert strain.active


def test_no_limit_of_memory_is_never_reached() -> None:
    strain = Strain(MEMORY, Metrics())
    memory = Memory(0, strain)
    memory.observe()
    assert not strain.active


def test_the_process_has_some_memory() -> None:
    before = own_bytes()
    held = np.ones(64 << 20, np.uint8)
    assert own_bytes() - before > held.nbytes // 2
