"""`koop-dataset --system cylinder`: the same file each time, and all or nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from koop_clients.dataset.cli import Arguments, write
from koop_clients.dataset.flow import write_flow
from koop_clients.dataset.moments import FlowRecipe
from koop_clients.flow.cylinder import CylinderFlow
from koop_clients.flow.forcing import feedback, law, schedule
from koop_clients.flow.plant import starting
from koop_protocol import recording


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def recipe(small: CylinderFlow, **options: Any) -> FlowRecipe:
    return FlowRecipe(small.settings, **{"frames": 5, **options})


def contents(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    with h5py.File(path) as file:
        return {str(name): np.asarray(file[str(name)]) for name in file}, dict(file.attrs)


def test_the_file_is_a_koop_recording(small: CylinderFlow, tmp_path: Path) -> None:
    written: list[None] = []
    made = recipe(small, regimes=("schedule",), trajectories=2, seed=3)
    write_flow(tmp_path / "a.h5", made, wrote=lambda: written.append(None))
    arrays, attributes = contents(tmp_path / "a.h5")
    frames = arrays[recording.FRAMES_DATASET]
    assert frames.shape == (2, 5, 4, 32, 64)
    assert frames.dtype == np.float16
    assert len(written) == 10
    assert arrays[recording.CONTROLS_DATASET].shape == (2, 4, 1)
    assert attributes[recording.FORMAT_ATTRIBUTE] == recording.RECORDING_FORMAT
    assert attributes[recording.VERSION_ATTRIBUTE] == recording.RECORDING_VERSION
    assert attributes[recording.SYSTEM_ATTRIBUTE] == "cylinder"
    assert attributes[recording.RENDERER_ATTRIBUTE] == "koop-lbm-1"
    assert attributes[recording.ACTUATED_ATTRIBUTE]
    assert attributes[recording.DT_ATTRIBUTE] == 0.15
    assert list(attributes[recording.CHANNELS_ATTRIBUTE]) == ["rho", "rho u", "rho v", "E"]
    assert list(attributes[recording.WINDOW_ATTRIBUTE]) == [-2, 10, -3, 3]
    entry = json.loads(arrays[recording.PARAMETERS_DATASET][1])
    assert entry["regime"] == "schedule"
    assert entry["reynolds"] == 15
    assert entry["frame_time"] == pytest.approx(small.settings.frame_time)


def test_several_processes_write_the_same_file(small: CylinderFlow, tmp_path: Path) -> None:
    made = recipe(small, regimes=("mix",), trajectories=3, seed=3)
    written: list[None] = []
    write_flow(tmp_path / "one.h5", made)
    write_flow(tmp_path / "two.h5", made, wrote=lambda: written.append(None), workers=2)
    assert len(written) == 15
    one, two = (contents(tmp_path / f"{name}.h5")[0] for name in ("one", "two"))
    for name, values in one.items():
        np.testing.assert_array_equal(values, two[name])


def test_what_goes_wrong_in_a_process_is_told(small: CylinderFlow, tmp_path: Path) -> None:
    made = recipe(small, regimes=("mix",), trajectories=2, seed=-1)
    with pytest.raises(ValueError, match="non-negative"):
        write_flow(tmp_path / "a.h5", made, workers=2)
    assert not list(tmp_path.iterdir())


def test_frames_and_controls_are_numbered_alike(small: CylinderFlow, tmp_path: Path) -> None:
    """Control k acts between frames k and k+1."""
    write_flow(tmp_path / "a.h5", recipe(small, regimes=("schedule",), seed=3))
    arrays, attributes = contents(tmp_path / "a.h5")
    state, turn = starting(small, (3, 0)), schedule((3, 0))
    for k in range(5):
        channels = small.channels(state)
        scale, mean = attributes["channel_scale"], attributes["channel_mean"]
        shown = arrays["frames"][0, k].astype(float) * scale[:, None, None] + mean[:, None, None]
        assert np.abs(shown - channels).max() < 1e-3
        assert arrays["states"][0, k, 0] == small.probe(state)
        if k < 4:
            assert arrays["controls"][0, k, 0] == turn(k, 0.0) != 0
        state = small.frame(state, turn(k, 0.0))


def test_feedback_knows_the_frame_that_it_acts_on(small: CylinderFlow, tmp_path: Path) -> None:
    write_flow(tmp_path / "a.h5", recipe(small, regimes=("feedback",)))
    arrays, _ = contents(tmp_path / "a.h5")
    turn = feedback(stir=(0, 0))
    for k in range(4):
        assert arrays["controls"][0, k, 0] == turn(k, arrays["states"][0, k, 0])


def test_the_same_seed_makes_the_same_file(small: CylinderFlow, tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        made = recipe(small, regimes=("schedule",), trajectories=2, seed=seed)
        write_flow(tmp_path / f"{name}.h5", made)
    frames, again, other = (contents(tmp_path / f"{n}.h5")[0]["frames"] for n in "abc")
    assert np.array_equal(frames, again)
    assert not np.array_equal(frames, other)
    assert not np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[1], other[0])


def test_trajectories_take_regimes_in_turn(small: CylinderFlow, tmp_path: Path) -> None:
    made = recipe(small, regimes=("schedule", "chirp"), trajectories=3, seed=3)
    write_flow(tmp_path / "a.h5", made)
    arrays, _ = contents(tmp_path / "a.h5")
    turned = arrays["controls"][:, :, 0]
    laws = schedule((3, 0)), law("chirp", (3, 1)), schedule((3, 2))
    assert np.array_equal(turned, [[turn(k, 0.0) for k in range(4)] for turn in laws])
    told = [json.loads(entry)["regime"] for entry in arrays[recording.PARAMETERS_DATASET]]
    assert told == ["schedule", "chirp", "schedule"]


def test_the_steady_flow_stands_still(small: CylinderFlow, tmp_path: Path) -> None:
    write_flow(tmp_path / "a.h5", recipe(small, regimes=("steady",), frames=0))
    arrays, attributes = contents(tmp_path / "a.h5")
    assert arrays["frames"].shape == (1, 1, 4, 32, 64)
    assert arrays["controls"].shape == (1, 0, 0)
    assert not attributes[recording.ACTUATED_ATTRIBUTE]
    my = arrays["frames"][0, 0, 2].astype(float)
    assert np.allclose(my, -my[::-1], atol=2e-3)
    assert np.ptp(my) > 1


def test_the_paper_s_lengths() -> None:
    options = {"rest": 4328, "schedule": 5000, "mix": 5000, "steady": 1}
    for regime, length in options.items():
        assert FlowRecipe(CylinderFlow().settings, (regime,)).length == length  # pyright: ignore


def test_a_failure_leaves_the_old_file(small: CylinderFlow, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(b"precious")

    def fail() -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_flow(path, recipe(small), wrote=fail)
    assert path.read_bytes() == b"precious"
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_the_command_writes_it(
    small: CylinderFlow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr("koop_clients.dataset.cli.FlowSettings", lambda **_: small.settings)
    write(Arguments("cylinder", tmp_path / "a.h5", frames=3, actuated=True, rotation=("mix",)))
    arrays, _ = contents(tmp_path / "a.h5")
    assert arrays["frames"].shape == (1, 3, 4, 32, 64)
    assert json.loads(arrays["parameters"][0])["regime"] == "mix"
    said = capsys.readouterr()
    assert said.out == f"wrote {tmp_path / 'a.h5'}: 1 trajectory of 3 frames\n"
    assert "3/3" in said.err
    both = Arguments(
        "cylinder", tmp_path / "b.h5", frames=3, actuated=True, rotation=("mix", "chirp")
    )
    write(both)
    regimes = [json.loads(e)["regime"] for e in contents(tmp_path / "b.h5")[0]["parameters"]]
    assert regimes == ["mix", "chirp"]


@pytest.mark.parametrize(
    ("system", "options", "words"),
    [
        ("cylinder", {"vary": True}, "--vary is for the mechanical systems; leave it out"),
        ("cylinder", {"excitation": "soft"}, "--excitation is for the mechanical systems"),
        ("cylinder", {"change_at": 3}, "--change-at is for the mechanical systems"),
        ("cylinder", {"reynolds": 1e4}, "the Reynolds number is 10000; expected 1 to"),
        ("cylinder", {"reynolds": 0.0}, "the Reynolds number is 0; expected 1 to"),
        ("cylinder", {"rotation": ("mix",)}, "--rotation mix needs a motor: add --actuated"),
        ("cylinder", {"steady": True, "actuated": True}, "leave --actuated out"),
        ("cylinder", {"trajectories": 0}, "--trajectories must be at least 1"),
        ("pendulum", {"reynolds": 50.0}, "--reynolds is for the cylinder; leave it out"),
        ("pendulum", {"steady": True}, "--steady is for the cylinder"),
    ],
)
def test_nonsense_is_refused(
    tmp_path: Path, system: Any, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        write(Arguments(system, tmp_path / "a.h5", **options))
    assert not any(tmp_path.iterdir())
