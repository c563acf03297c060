"""Kept flows: made once, whatever else happens."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from koop_clients.flow import spinup
from koop_clients.flow.cache import cache_folder, kept
from koop_clients.flow.cylinder import CylinderFlow
from koop_clients.flow.spinup import developed, steady

LIKE = ((3, 4), np.dtype(np.float32))
SETTINGS = {"reynolds": 50.0, "dtype": "float32"}


class Maker:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> np.ndarray:
        self.calls += 1
        return np.ones(*LIKE)


def get(folder: Path, make: Any, settings: dict[str, Any] | None = None) -> np.ndarray:
    return kept(folder, "flow", settings or SETTINGS, LIKE, make)


def test_it_is_made_once_for_each_settings(tmp_path: Path) -> None:
    make = Maker()
    folder = tmp_path / "not" / "there" / "yet"
    for _ in range(3):
        assert np.array_equal(get(folder, make), np.ones((3, 4)))
    assert make.calls == 1
    get(folder, make, {**SETTINGS, "reynolds": 51.0})
    assert make.calls == 2


def test_any_damage_is_noticed_and_mended(tmp_path: Path) -> None:
    get(tmp_path, Maker())
    (path,) = tmp_path.glob("*.npz")
    sound = path.read_bytes()
    damaged = [sound[:n] for n in range(0, len(sound), 7)]
    for position in range(len(sound)):
        damaged.append(bytearray(sound))
        damaged[-1][position] ^= 0x40
    for content in damaged:
        path.write_bytes(content)
        found = get(tmp_path, Maker())
        assert np.array_equal(found, np.ones((3, 4)))
        assert found.dtype == np.float32


@pytest.mark.parametrize("array", [np.ones((4, 3), np.float32), np.ones((3, 4))])
def test_what_does_not_fit_is_made_again(tmp_path: Path, array: np.ndarray) -> None:
    get(tmp_path, lambda: array)
    make = Maker()
    assert get(tmp_path, make).shape == (3, 4)
    assert make.calls == 1


def test_a_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail() -> np.ndarray:
        raise ArithmeticError("diverged")

    with pytest.raises(ArithmeticError, match="diverged"):
        get(tmp_path, fail)
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".lock"]


def test_without_a_folder_it_is_made_with_a_warning(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    make = Maker()
    for _ in range(2):
        with pytest.warns(UserWarning, match="set XDG_CACHE_HOME to a folder that can be written"):
            get(tmp_path / "file" / "below", make)
    assert make.calls == 2


def test_a_disk_that_is_full_costs_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.warns(UserWarning, match="No space left on device"):
        assert np.array_equal(get(tmp_path, Maker()), np.ones((3, 4)))
    assert not list(tmp_path.glob("*.npz*"))


def _start(folder: Path, log: Path, seconds: float) -> None:
    def make() -> np.ndarray:
        with log.open("a") as file:
            file.write("made\n")
        time.sleep(seconds)
        return np.ones((3, 4), np.float32)

    assert np.array_equal(get(folder, make), np.ones((3, 4)))


def test_of_several_starters_one_makes_it(tmp_path: Path) -> None:
    context, log = multiprocessing.get_context("fork"), tmp_path / "log"
    starters = [context.Process(target=_start, args=(tmp_path, log, 0.3)) for _ in range(4)]
    for starter in starters:
        starter.start()
    for starter in starters:
        starter.join()
    assert [starter.exitcode for starter in starters] == [0] * 4
    assert log.read_text() == "made\n"


def test_a_killed_starter_holds_nobody_up(tmp_path: Path) -> None:
    context, log = multiprocessing.get_context("fork"), tmp_path / "log"
    starter = context.Process(target=_start, args=(tmp_path, log, 60.0))
    starter.start()
    while not log.exists():
        time.sleep(0.01)
    assert starter.pid is not None
    os.kill(starter.pid, signal.SIGKILL)
    starter.join()
    make = Maker()
    get(tmp_path, make)
    assert make.calls == 1


def test_what_a_killed_process_left_is_cleared_away(tmp_path: Path) -> None:
    get(tmp_path, Maker())
    (path,) = tmp_path.glob("*.npz")
    path.unlink()
    mine, other = tmp_path / f"{path.name}.abc.partial", tmp_path / "flow-x.npz.abc.partial"
    for left_over in (mine, other):
        left_over.write_bytes(b"half")
    get(tmp_path, Maker())
    assert not mine.exists()
    assert other.exists()


def test_the_folder_is_the_user_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert cache_folder() == Path("/somewhere/koop/flow")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative/is/ignored")
    assert cache_folder() == Path.home() / ".cache" / "koop" / "flow"


def test_flows_are_made_once_and_told_apart(
    small: CylinderFlow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[int, int]] = []
    state = developed(small, lambda *at: told.append(at), tmp_path)
    assert [done for done, _ in told] == list(range(1, told[-1][1] + 1))
    calm = steady(small, folder=tmp_path)
    assert not np.array_equal(calm, state)
    monkeypatch.setattr(spinup, "_develop", None)  # any use of it would fail
    monkeypatch.setattr(spinup, "_average", None)
    assert np.array_equal(developed(small, folder=tmp_path), state)
    assert np.array_equal(steady(small, folder=tmp_path), calm)


def test_the_steady_flow_is_symmetric_and_stays(small: CylinderFlow, tmp_path: Path) -> None:
    calm = steady(small, folder=tmp_path)
    assert np.allclose(calm, small.mirrored(calm), atol=1e-7)
    assert abs(small.probe(calm)) < 1e-6
    change = small.channels(small.frame(calm)) - small.channels(calm)
    assert np.abs(change).max() < 1e-3
    assert np.ptp(small.channels(calm)[1]) > 0.2
