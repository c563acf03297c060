"""The loop itself, its parts played by others: a turn that fails is not the last one."""

from __future__ import annotations

import logging
import threading
from unittest.mock import MagicMock

import pytest

from koop_service.serving.pipeline import Pipeline

FAILURES = 5


@pytest.mark.parametrize("part", ["wait", "take"])
def test_a_turn_that_fails_is_logged_and_the_next_ones_come(
    part: str, caplog: pytest.LogCaptureFixture
) -> None:
    calls, again = [], threading.Event()

    def fail_at_first(*_: object) -> list[object]:
        calls.append(part)
        if len(calls) <= FAILURES:
            raise RuntimeError("a fault of ours")
        again.set()
        return []

    intake, desk, recovery, snapshotter = (MagicMock() for _ in range(4))
    intake.take.return_value = []
    getattr(intake, part).side_effect = fail_at_first
    intake.depth, desk.busy, recovery.is_busy, recovery.behind = 0, False, False, 0
    desk.urgent.return_value = recovery.take.return_value = []
    recovery.pause.return_value = snapshotter.pause.return_value = 0.0
    others = MagicMock(), desk, MagicMock(), MagicMock(), recovery, snapshotter, MagicMock()
    pipeline = Pipeline(intake, *others, batch=64, lost=MagicMock())
    with caplog.at_level(logging.ERROR, "koop.pipeline"):
        pipeline.start()
        assert again.wait(30), "the thread has ended"
        pipeline.stop(30)
    assert pipeline.finished
    (record,) = caplog.records  # the other failures came within the same ten seconds
    assert "the service goes on" in record.getMessage()
    assert record.exc_info is not None
