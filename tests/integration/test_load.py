"""Nothing is lost, whatever the pace: several sources at full speed against a small queue."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest
from integration.loopback import Loop, burst, config_for, loop, wait_until

from koop_protocol import PredictReply
from koop_service.serving.measurements import Measurements

TRAJECTORIES, FRAMES = 20, 120


def test_a_burst_from_two_processes_loses_nothing(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with loop(config_for(tmp_path, model, queue_messages=64)) as koop:
        fold = Measurements.process

        def fold_once_full(measurements: Measurements, arrivals: list) -> dict:
            wait_until(lambda: koop.service.metrics.value("koop_held_total") > 0, "a full queue")
            return fold(measurements, arrivals)

        monkeypatch.setattr(Measurements, "process", fold_once_full)
        spawn = multiprocessing.get_context("spawn")
        processes = [
            spawn.Process(
                target=burst, args=(koop.service.endpoints[0], 100 * i, TRAJECTORIES, FRAMES)
            )
            for i in (1, 2)
        ]
        for process in processes:
            process.start()
        asked = ask_while(koop, processes)
        total = 2 * TRAJECTORIES * FRAMES
        wait_until(lambda: koop.service.metrics.value("koop_frames_total") == total)
        assert koop.lost() == 0
        states = koop.ask("koop/state/**")
        assert len(states) == 2 * TRAJECTORIES
        assert {(s.next_seq, s.updates, s.counters["gaps"]) for s in states} == {
            (FRAMES, FRAMES - 2, 0)
        }
        assert asked > 0


def ask_while(koop: Loop, processes: list) -> int:
    """Predictions answered for a third session while the sources are held back."""
    answered = 0
    while any(process.is_alive() for process in processes):
        replies = koop.ask("koop/predict/cart/100?horizon=5")
        answered += sum(isinstance(reply, PredictReply) for reply in replies)
    for process in processes:
        process.join()
        assert process.exitcode == 0
    return answered
