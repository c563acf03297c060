"""The demo's verdict, its picture, and that it leaves no process behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from koop_clients.demo import processes
from koop_clients.demo.processes import DemoError, command, free_endpoint, service, sim_client
from koop_clients.demo.verdict import failures, table
from koop_clients.pictures.film import most_motion
from koop_clients.pictures.hero import draw_hero
from koop_clients.pictures.strip import draw_strip
from koop_clients.sim_client.record import Record, stack_series
from koop_clients.sim_client.scoring import Forecast, Judged, judge

ERRORS = {"horizons": [1, 20], "error": [0.01, 0.02], "repeat": [0.03, 0.15], "count": 50}
DRIVE = {
    "final_error": 0.01, "worst_error_at_end": 0.02, "settled_after": 1.5, "largest_torque": 20.0,
    "success": True,
}  # fmt: skip
LATENCY = {"count": 9, "p50": 0.006, "p99": 0.0125}
BURST = {"frames_per_s": 1234.5, "trajectories": 20, "predict": LATENCY}


def run(**changes: Any) -> dict[str, Any]:
    values = {
        "early": ERRORS, "late": ERRORS, "drives": [{"outcome": DRIVE}], "predict": LATENCY,
        "totals": {"command": LATENCY},
    }  # fmt: skip
    return {**values, **changes}


def drives(**changes: Any) -> list[dict[str, Any]]:
    return [{"outcome": {**DRIVE, **changes}}]


def test_a_good_run_has_no_objections() -> None:
    assert failures(run()) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"late": None}, ["no prediction was answered and came true"]),
        (
            {"late": {**ERRORS, "error": [0.01, 0.15]}},
            ["1 s ahead the predictions (RMSE 0.1500) are no better than repeating the last frame "
             "(0.1500)"],
        ),
        ({"late": {**ERRORS, "error": [0.01, float("nan")]}}, ["1 s ahead"]),
        ({"drives": [{"outcome": None}]}, ["the service did not drive"]),
        ({"drives": []}, ["the service did not drive"]),
        (
            {"drives": [{"outcome": {**DRIVE, "success": False, "worst_error_at_end": 3.0}}]},
            ["the pole did not stay at its target: 3.00 rad off in the last 2 s"],
        ),
    ],
)  # fmt: skip
def test_every_shortcoming_is_objected_to(changes: dict[str, Any], words: list[str]) -> None:
    found = failures(run(**changes))
    assert len(found) == len(words)
    assert all(text.startswith(start) for text, start in zip(found, words, strict=True))


def test_the_table_tells_it_in_a_few_lines() -> None:
    text = table(run(), BURST)
    assert len(text.splitlines()) <= 10
    assert "last predictions             0.0100   0.0200" in text
    assert "repeating the last frame     0.0300   0.1500" in text
    assert "upright within 0.1 rad after 1.50 s, 0.020 rad off at worst in the last 2 s" in text
    assert "prediction p50 6.0 ms, p99 12.5 ms" in text
    assert "1234 frames/s from 20 plants" in text
    assert "frame to command          p50 6.0 ms, p99 12.5 ms, a new plan" in text
    bad = drives(success=False, worst_error_at_end=2.5)
    assert "NOT at the target, 2.50 rad off" in table(run(drives=bad), BURST)


def moving(seq: int, speed: int) -> Judged:
    """A bright square that moves `speed` pixels a frame, predicted to stand still."""
    frames = np.zeros((21, 64, 64), np.uint8)
    for i, frame in enumerate(frames):
        frame[20:30, 5 + i * speed : 15 + i * speed] = 255
    return judge(Forecast(seq, frames[0], np.repeat(frames[:1], 20, 0)), frames[1:])


def record(early: list[Judged], late: list[Judged], drive: int = 60) -> Record:
    series = np.linspace((1, 0, -20), (0, 0, 5), drive)
    frames = np.zeros((drive, 64, 64), np.uint8)
    return Record("cartpole", early, late, frames, stack_series([series]), 0.0, 20.0)


def test_no_easy_forecast_is_picked() -> None:
    still, quick = moving(3, 0), moving(4, 2)
    assert most_motion([still, quick, still]) is quick


def test_the_pictures_are_two_thousand_pixels_wide(tmp_path: Path) -> None:
    full = record([moving(40, 1)], [moving(300, 2)])
    draw_hero(full, tmp_path / "hero.png")
    draw_strip(full, tmp_path / "strip.png")
    hero, strip = (matplotlib.image.imread(tmp_path / f"{n}.png") for n in ("hero", "strip"))
    assert hero.shape[1] == strip.shape[1] == 2000
    amber = (hero[..., 0] > 0.9) & (hero[..., 1] > 0.5) & (hero[..., 2] < 0.3)
    assert amber.sum() > 1000


def test_a_picture_without_contents_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="early and late predictions and a drive"):
        draw_hero(record([moving(1, 1)], []), tmp_path / "hero.png")
    with pytest.raises(ValueError, match="stream for longer"):
        draw_strip(record([], []), tmp_path / "strip.png")


def test_a_record_comes_back_as_it_was(tmp_path: Path) -> None:
    series = [np.arange(12.0).reshape(4, 3), np.ones((2, 3))]
    frames = np.arange(4 * 64 * 64, dtype=np.uint8).reshape(4, 64, 64)
    kept = Record("cartpole", [moving(4, 1)], [], frames, stack_series(series), 0.3, 20.0)
    kept.save(tmp_path / "run.npz")
    found = Record.load(tmp_path / "run.npz")
    assert np.array_equal(found.drive_frames, frames)
    assert found.drive_angles.tolist() == [0.0, 3.0, 6.0, 9.0]
    assert found.drive_torques.tolist() == [2.0, 5.0, 8.0, 11.0]
    assert found.drives.shape == (2, 4, 3)
    assert np.isnan(found.drives[1, 2:]).all()
    assert (found.target, found.torque_bound, found.ahead) == (0.3, 20.0, 20)


def test_a_missing_command_is_named() -> None:
    with pytest.raises(DemoError, match="there is no command koop-nothing"):
        command("koop-nothing")
    assert Path(command("koop-sim-client")).parent == Path(sys.executable).parent


def test_free_endpoints_are_free_and_local() -> None:
    assert free_endpoint().startswith("tcp/127.0.0.1:")
    assert not free_endpoint().endswith(":0")


def fake_command(folder: Path, script: str) -> Path:
    path = folder / "fake"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def test_a_failed_client_is_told_with_the_service_s_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve = fake_command(tmp_path, "echo I have no weights; exec sleep 60")
    client = tmp_path / "client"
    client.write_text("#!/bin/sh\nsleep 0.5; exit 3\n")
    client.chmod(0o755)
    found = {"koop-serve": str(serve), "koop-sim-client": str(client)}
    monkeypatch.setattr(processes, "command", found.__getitem__)
    words = r"(?s)exit code 3; the service said:.*I have no weights"
    with pytest.raises(DemoError, match=words), service("tcp/127.0.0.1:1", tmp_path, []):
        sim_client("tcp/127.0.0.1:1", [])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_killed_demo_leaves_no_child(tmp_path: Path, number: signal.Signals) -> None:
    child = fake_command(tmp_path, f'trap "" INT; echo $$ >> {tmp_path}/pids; exec sleep 60')
    code = (
        "import signal\n"
        "from pathlib import Path\n"
        "from koop_clients.demo import processes as p\n"
        # Where the tests run in a shell's background, SIGINT is inherited as ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"p.command = lambda _: {str(child)!r}\n"
        "p.end_cleanly_on_sigterm()\n"
        f"with p.service('e', Path({str(tmp_path)!r}), []): p.sim_client('e', [])"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    children = _wait_for_lines(tmp_path / "pids", 2)
    time.sleep(0.5)  # a child can write before Popen has returned in its parent
    process.send_signal(number)
    assert process.wait(60) != 0
    for pid in children:
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid), 0)


def _wait_for_lines(path: Path, count: int) -> list[str]:
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        if path.is_file() and len(lines := path.read_text().splitlines()) == count:
            return lines
        time.sleep(0.02)
    raise AssertionError("the children did not start")
