"""`koop-dataset`: reproducible on any number of workers, and all or nothing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from koop_clients.dataset import cli
from koop_clients.dataset.cli import Arguments, write
from koop_protocol import recording


def small(path: Path, **options: Any) -> Arguments:
    return Arguments("cartpole", path, trajectories=5, frames=6, actuated=True, **options)


def contents(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    with h5py.File(path) as file:
        arrays = {str(name): np.asarray(file[str(name)]) for name in file}
        return arrays, dict(file.attrs)


def test_the_file_is_a_koop_recording(tmp_path: Path) -> None:
    write(small(tmp_path / "a.h5", workers=1, vary=True, seed=3))
    arrays, attributes = contents(tmp_path / "a.h5")
    assert arrays[recording.FRAMES_DATASET].shape == (5, 6, 64, 64)
    assert arrays[recording.FRAMES_DATASET].dtype == np.uint8
    assert arrays[recording.CONTROLS_DATASET].shape == (5, 5, 1)
    assert arrays[recording.STATES_DATASET].shape == (5, 6, 4)
    assert attributes[recording.FORMAT_ATTRIBUTE] == recording.RECORDING_FORMAT
    assert attributes[recording.SYSTEM_ATTRIBUTE] == "cartpole"
    assert attributes[recording.ACTUATED_ATTRIBUTE]
    assert attributes[recording.SEED_ATTRIBUTE] == 3
    entries = [json.loads(line) for line in arrays[recording.PARAMETERS_DATASET]]
    assert len({entry["length"] for entry in entries}) == 5
    assert all("regime" in entry for entry in entries)


def test_a_free_plant_has_no_controls(tmp_path: Path) -> None:
    write(Arguments("pendulum", tmp_path / "a.h5", trajectories=2, frames=4, workers=1))
    arrays, _ = contents(tmp_path / "a.h5")
    assert arrays[recording.CONTROLS_DATASET].shape == (2, 3, 0)


def test_one_worker_and_two_make_the_same_set(tmp_path: Path) -> None:
    for workers in (1, 2):
        write(small(tmp_path / f"{workers}.h5", workers=workers, vary=True))
    (one, _), (two, _) = contents(tmp_path / "1.h5"), contents(tmp_path / "2.h5")
    assert one.keys() == two.keys()
    assert all(np.array_equal(one[name], two[name]) for name in one)


def test_another_seed_makes_another_set(tmp_path: Path) -> None:
    for seed in (1, 2):
        write(small(tmp_path / f"{seed}.h5", workers=1, seed=seed))
    (one, _), (two, _) = contents(tmp_path / "1.h5"), contents(tmp_path / "2.h5")
    assert not np.array_equal(one[recording.FRAMES_DATASET], two[recording.FRAMES_DATASET])


def test_a_failure_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(b"precious")

    def fail(*_: object) -> Iterator[object]:
        yield from ()
        raise OSError("disk full")

    monkeypatch.setattr(cli, "generate", fail)
    with pytest.raises(OSError, match="disk full"):
        write(small(path, workers=1))
    assert path.read_bytes() == b"precious"


@pytest.mark.parametrize("options", [{"trajectories": 0}, {"frames": -1}])
def test_nonsense_is_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="--trajectories must be at least 1"):
        write(Arguments("pendulum", tmp_path / "a.h5", **options))


def manifest_of(path: Path) -> list[dict[str, Any]]:
    arrays, _ = contents(path)
    return [json.loads(line) for line in arrays[recording.PARAMETERS_DATASET]]


@pytest.mark.parametrize("regime", ["free", "soft-hanging"])
def test_each_regime_can_be_asked_for(tmp_path: Path, regime: Any) -> None:
    write(small(tmp_path / "a.h5", workers=1, excitation=regime))
    arrays, _ = contents(tmp_path / "a.h5")
    assert {entry["regime"] for entry in manifest_of(tmp_path / "a.h5")} == {regime}
    assert arrays[recording.CONTROLS_DATASET].shape == (5, 5, 1)
    assert bool(arrays[recording.CONTROLS_DATASET].any()) == (regime != "free")


def test_a_motor_that_is_not_there_cannot_drive(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--excitation soft needs a motor: add --actuated"):
        write(Arguments("pendulum", tmp_path / "a.h5", excitation="soft"))


def test_a_change_is_in_the_manifest_and_leaves_what_was_before_alone(tmp_path: Path) -> None:
    changed = {"change_at": 4, "change": ("mass:2", "length:0.8")}
    for name, options in {"plain": {}, "changed": changed}.items():
        write(small(tmp_path / f"{name}.h5", workers=1, vary=True, **options))
    (plain, _), (other, _) = (contents(tmp_path / f"{n}.h5") for n in ("plain", "changed"))
    frames = [arrays[recording.FRAMES_DATASET] for arrays in (plain, other)]
    assert np.array_equal(frames[0][:, :4], frames[1][:, :4])
    assert all((frames[0][i, 4] != frames[1][i, 4]).any() for i in range(5))
    for entry in manifest_of(tmp_path / "changed.h5"):
        change = entry["change"]
        assert change["at"] == 4
        assert change["mass"] == pytest.approx(2 * entry["mass"])
        assert change["length"] == pytest.approx(0.8 * entry["length"])
        assert change["cart_mass"] == entry["cart_mass"]
    assert all("change" not in entry for entry in manifest_of(tmp_path / "plain.h5"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"change": ("mass:2",)}, "--change and --change-at go together"),
        ({"change_at": 3}, "--change and --change-at go together"),
        ({"change_at": 6, "change": ("mass:2",)}, "--change-at is 6; expected a frame from 1 to 5"),
        ({"change_at": 3, "change": ("mess:2",)}, "has cart_mass, mass, length to change"),
        ({"change_at": 3, "change": ("damping:2",)}, "has cart_mass, mass, length to change"),
        ({"change_at": 3, "change": ("mass=2",)}, "mass=2: cartpole has"),
        ({"change_at": 3, "change": ("mass:",)}, "expected a factor above 0, as in mass:1.5"),
        ({"change_at": 3, "change": ("mass:-1",)}, "expected a factor above 0"),
    ],
)
def test_a_change_that_makes_no_sense_is_refused(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        write(small(tmp_path / "a.h5", **options))
    assert not any(tmp_path.iterdir())


def test_a_plant_that_leaves_the_picture_is_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(small(tmp_path / "in.h5", workers=1))
    assert "leave the picture" not in capsys.readouterr().err
    write(small(tmp_path / "out.h5", workers=1, change_at=2, change=("length:1.6",)))
    assert "5 of 5 trajectories leave the picture" in capsys.readouterr().err
