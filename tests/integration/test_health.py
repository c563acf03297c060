"""Health: an answer means that the pipeline moves, not only that the process lives."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from integration.loopback import DEADLINE, Loop, Source, client, config_for, loop, wait_until

from koop_clients import health
from koop_clients.queries import NO_REPLY, KoopClient, KoopError
from koop_protocol import ENCODER_FAILS
from koop_service.serving.config import MonitoringSettings
from koop_service.serving.measurements import Measurements
from koop_service.serving.monitoring.watchdog import EXIT_CODE

STUCK = """
import threading
from koop_service.serving.measurements import Measurements
Measurements.process = lambda *_: threading.Event().wait()
"""
"""A pipeline that waits for what never comes, as on a lock."""


def test_a_service_is_asked_how_it_is(koop: Loop, capsys: pytest.CaptureFixture[str]) -> None:
    (first,) = KoopClient(koop.session, DEADLINE).health()
    assert (first.trajectories, first.last_fold, first.degraded) == (0, None, ())
    Source(koop.session, "cart/0").stream(40)
    koop.state("cart/0")
    (then,) = KoopClient(koop.session, DEADLINE).health()
    assert (then.trajectories, then.queue) == (1, 0)
    assert then.last_fold is not None
    health.main(["--connect", koop.service.endpoints[0], "--here", "--timeout", str(DEADLINE)])
    assert re.match(r"\S+:\d+ is healthy: koop .* 1 trajectories", capsys.readouterr().out)


def test_a_stuck_pipeline_does_not_answer(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, process = threading.Event(), Measurements.process

    def wait(measurements: Measurements, arrivals: list) -> dict:
        gate.wait()
        return process(measurements, arrivals)

    monkeypatch.setattr(Measurements, "process", wait)
    watched = MonitoringSettings(stuck_after=2.0, exit_when_stuck=False)
    with loop(replace(config_for(tmp_path, model), monitoring=watched)) as koop:
        try:
            asked = KoopClient(koop.session, 0.5)
            Source(koop.session, "cart/0").stream(1)
            wait_until(lambda: koop.service.metrics.value("koop_stuck_total") == 1)
            with pytest.raises(KoopError) as refusal:
                asked.health()
            assert refusal.value.code == NO_REPLY
            with pytest.raises(SystemExit, match="nobody answered on koop/health"):
                health.main(["--connect", koop.service.endpoints[0], "--timeout", "0.5"])
        finally:
            gate.set()
        assert KoopClient(koop.session, DEADLINE).health()
        assert koop.state("cart/0").frames == 1


@contextmanager
def program(broken: str, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A koop-serve that is broken by some lines of Python, and its endpoint."""
    command = [sys.executable, "-c", broken + "from koop_service.cli import main; main()", *options]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)
    try:
        yield process, re.search(r"ready on (\S+)", process.stdout.readline())[1]
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("frees_the_interpreter", [True, False])
def test_a_stuck_process_says_where_and_ends(
    frees_the_interpreter: bool, tmp_path: Path, model: Path
) -> None:
    """Without the interpreter's lock the watchdog cannot run, and faulthandler's timer has to."""
    network = shutil.copy(model, tmp_path / "network.safetensors")
    options = ["--listen", "tcp/127.0.0.1:0", "--models", f"cart*={model}", f"far*={network}"]
    options += ["--state-folder", str(tmp_path / "state"), "--stuck-after", "2"]
    broken = STUCK if frees_the_interpreter else ""
    with program(broken, *options) as (process, endpoint):
        # Weights on a network drive that hangs: opening them never returns, nor frees Python.
        os.remove(network)
        os.mkfifo(network)
        with client(endpoint) as session:
            assert KoopClient(session, DEADLINE).health()
            Source(session, "far/0").stream(1)
            _, told = process.communicate(timeout=DEADLINE)
    assert process.returncode == (EXIT_CODE if frees_the_interpreter else 1), told
    assert ("has not turned for 2 s; the process ends" in told) == frees_the_interpreter
    assert "in step" in told  # the pipeline's own stack
    assert ("load_card" in told) != frees_the_interpreter


BROKEN = """
from koop_service.encoding.image_codec import ImageCodec
from koop_service.serving.measurements import Measurements
def fail(*_, **__):
    raise RuntimeError("the device is gone")
process = Measurements.process
def break_first(self, arrivals):
    ImageCodec.encode = fail
    return process(self, arrivals)
Measurements.process = break_first
"""
"""A device that goes when the first frame comes."""


def test_a_process_that_cannot_encode_says_so_and_ends(tmp_path: Path, model: Path) -> None:
    options = ["--listen", "tcp/127.0.0.1:0", "--models", f"cart*={model}"]
    options += ["--state-folder", str(tmp_path / "state"), "--stuck-after", "8"]
    with program(BROKEN, *options) as (process, endpoint), client(endpoint) as session:
        koop = KoopClient(session, DEADLINE)
        assert koop.health()[0].degraded == ()
        Source(session, "cart/0").stream(1)
        wait_until(lambda: koop.health()[0].degraded == (ENCODER_FAILS,), "the news")
        _, told = process.communicate(timeout=DEADLINE)
    assert process.returncode == EXIT_CODE, told
    assert "the device is gone" in told
    assert "nothing could be encoded for 8 s; the process ends" in told
