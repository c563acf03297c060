"""Recordings that do not fit, each told in words that help."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest

from koop_protocol import recording as names
from koop_service.learning import recording
from koop_service.learning.recording import load_manifest, load_recording

N, T = 3, 5
FRAMES = np.random.default_rng(0).integers(0, 256, (N, T, 64, 64), np.uint8)
CONTROLS = np.random.default_rng(1).normal(size=(N, T - 1, 1))
MANIFEST = [json.dumps({"regime": "free", "mass": 1.0 + i}) for i in range(N)]
ATTRIBUTES: dict[str, Any] = {
    names.FORMAT_ATTRIBUTE: names.RECORDING_FORMAT,
    names.VERSION_ATTRIBUTE: names.RECORDING_VERSION,
    names.SYSTEM_ATTRIBUTE: "crane",
    names.RENDERER_ATTRIBUTE: "",
    names.DT_ATTRIBUTE: 0.05,
    names.SEED_ATTRIBUTE: 0,
}


def write(path: Path, leave_out: str = "", **changes: Any) -> Path:
    """A good recording but for `changes` of its data sets and attributes."""
    parts: dict[str, Any] = {
        names.FRAMES_DATASET: FRAMES,
        names.CONTROLS_DATASET: CONTROLS,
        names.PARAMETERS_DATASET: MANIFEST,
    }
    with h5py.File(path, "w") as file:
        for name, values in parts.items():
            if name != leave_out:
                file.create_dataset(name, data=changes.get(name, values))
        for name, value in ATTRIBUTES.items():
            if name != leave_out:
                file.attrs[name] = changes.get(name, value)
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.h5"


def test_a_good_one_is_read_whole(path: Path) -> None:
    found = load_recording(write(path))
    assert np.array_equal(found.frames, FRAMES)
    assert np.array_equal(found.controls, CONTROLS)
    assert (found.system, found.renderer, found.dt, found.seed) == ("crane", "", 0.05, 0)
    assert [entry["mass"] for entry in load_manifest(path)] == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": "lerobot"}, r"is not a koop recording; make one with koop-dataset or koop-rec"),
        ({"version": 2}, r"version 2; this koop reads 1"),
        ({"frames": FRAMES.astype(np.float32)}, r"\(3, 5, 64, 64\) float32; .*takes.*uint8"),
        ({"frames": FRAMES[..., :32]}, r"takes \(64, 64\) uint8"),
        ({"frames": FRAMES[0]}, r"holds frames \(5, 64, 64\) uint8"),
        ({"frames": np.uint8(7)}, r"holds frames \(\) uint8"),
        ({"frames": FRAMES[:0], "controls": CONTROLS[:0]}, r"holds 0 trajectories of 5 frames"),
        ({"frames": FRAMES[:, :1], "controls": CONTROLS[:, :0]}, r"at least 2 frames"),
        ({"controls": CONTROLS[:, 1:]}, r"controls \(3, 3, 1\); expected \(3, 4\) \+ \(p,\)"),
        ({"controls": CONTROLS[..., 0]}, r"controls \(3, 4\); expected"),
        ({"controls": np.full((N, T - 1, 1), b"on")}, r"controls of type .*; expected float64"),
        ({"controls": CONTROLS * np.nan}, r"controls that are not finite"),
        ({"controls": CONTROLS * np.inf}, r"controls that are not finite"),
        ({"dt": 0.0}, r"dt = 0.0 s between frames; expected a positive time"),
        ({"dt": -0.05}, r"dt = -0.05 s"),
        ({"dt": np.nan}, r"dt = nan s"),
        ({"dt": np.inf}, r"dt = inf s"),
        ({"dt": "50 ms"}, r"dt = .*50 ms.*; expected a number"),
        ({"dt": [0.05, 0.05]}, r"dt = .*; expected a number"),
        ({"system": 7}, r"system = .*7.*; expected text"),
    ],
)
def test_what_does_not_fit_is_explained(path: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=rf"a\.h5 .*{words}"):
        load_recording(write(path, **changes))


@pytest.mark.parametrize("missing", ["frames", "controls"])
def test_a_missing_data_set_is_named(path: Path, missing: str) -> None:
    with pytest.raises(
        ValueError, match=f"has no data set '{missing}'; make one with koop-dataset"
    ):
        load_recording(write(path, leave_out=missing))


@pytest.mark.parametrize("missing", ["system", "renderer", "dt", "seed"])
def test_a_missing_attribute_is_named(path: Path, missing: str) -> None:
    with pytest.raises(ValueError, match=f"has no attribute '{missing}'; make one with"):
        load_recording(write(path, leave_out=missing))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"leave_out": "parameters"}, "has no data set 'parameters'"),
        ({"parameters": MANIFEST[:2]}, r"has a manifest \(2,\) for 3 trajectories"),
        ({"parameters": [*MANIFEST[:2], "{"]}, "whose line 2 is no JSON object"),
        ({"parameters": [*MANIFEST[:2], "[1]"]}, "whose line 2 is no JSON object"),
        ({"parameters": np.zeros(3)}, "whose line 0 is no JSON object"),
    ],
)
def test_a_manifest_that_does_not_fit_is_explained(
    path: Path, changes: dict[str, Any], words: str
) -> None:
    write(path, **changes)
    with pytest.raises(ValueError, match=words):
        load_manifest(path)
    load_recording(path)  # training does not need it


def test_a_group_is_no_data_set(path: Path) -> None:
    with h5py.File(write(path, leave_out="frames"), "a") as file:
        file.create_group("frames")
    with pytest.raises(ValueError, match="has no data set 'frames'"):
        load_recording(path)


@pytest.mark.parametrize("content", [b"", b"no HDF5 at all", b"\x89HDF\r\n\x1a\n" + bytes(100)])
def test_another_kind_of_file_is_explained(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.h5 cannot be read as HDF5; is the copy complete"):
        load_recording(path)


def test_neither_a_folder_nor_nothing_is_a_recording(tmp_path: Path) -> None:
    for wrong in (tmp_path, tmp_path / "nowhere.h5"):
        with pytest.raises(ValueError, match="cannot be read as HDF5"):
            load_recording(wrong)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.999])
def test_a_truncated_file_is_explained(path: Path, share: float) -> None:
    content = write(path).read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"a\.h5 cannot be read as HDF5; is the copy complete"):
        load_recording(path)


def test_damaged_frames_are_explained(path: Path) -> None:
    write(path, leave_out="frames")
    with h5py.File(path, "a") as file:
        frames = file.create_dataset(
            "frames", data=FRAMES, chunks=(1, T, 64, 64), **hdf5plugin.Zstd(3)
        )
        chunk = frames.id.get_chunk_info(1)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.h5 is damaged in its /frames"):
        load_recording(path)


def test_a_file_too_large_for_the_memory_is_refused_before_it_is_read(path: Path) -> None:
    """A few kilobytes that declare 4 PiB: nothing is allocated for them."""
    write(path, leave_out="frames")
    with h5py.File(path, "a") as file:
        shape = (2**30, 2**10, 64, 64)
        file.create_dataset("frames", shape, np.uint8, chunks=(1, 2**10, 64, 64))
        del file["controls"]
        file.create_dataset("controls", (2**30, 2**10 - 1, 0), np.float64)
    with pytest.raises(ValueError, match=r"needs 4\.19e\+06 GiB of memory and [\d.]+ GiB are free"):
        load_recording(path)


def test_what_fits_the_memory_is_not_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = FRAMES.nbytes + CONTROLS.nbytes
    for free, fits in ((size, True), (size - 1, False)):
        monkeypatch.setattr(recording, "free_memory", lambda free=free: free)
        if fits:
            load_recording(write(path))
        else:
            with pytest.raises(ValueError, match="use fewer trajectories, or a larger machine"):
                load_recording(path)


def test_free_memory_is_a_number_of_bytes() -> None:
    assert 2**20 < recording.free_memory() < 2**50
