"""Segments survive on disk, and become one recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from koop_clients.recording.assembly import Segment
from koop_clients.recording.spool import Spool
from koop_protocol import recording as names


def segment(seed: int, dt: float = 0.05, p: int = 1) -> Segment:
    rng = np.random.default_rng(seed)
    frames = rng.integers(0, 256, (6, 64, 64), np.uint8)
    return Segment(
        f"rig/{seed}", "c" * 16, 6 * seed, frames, rng.normal(size=(5, p)), dt * np.arange(6)
    )


def test_segments_become_one_recording(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "deep" / "a.h5")
    spool.begin()
    segments = [segment(seed, dt) for seed, dt in ((0, 0.0501), (1, 0.04996), (2, 0.0502))]
    for item in segments:
        spool.add(item, "r")
    joined = spool.join()
    assert (joined.count, joined.length, joined.header.dt) == (3, 6, 0.0501)
    assert joined.spread < 0.01
    assert not spool.folder.exists()
    with h5py.File(tmp_path / "deep" / "a.h5") as opened:
        file: Any = opened
        assert np.array_equal(file[names.FRAMES_DATASET], [s.frames for s in segments])
        assert np.array_equal(file[names.CONTROLS_DATASET], [s.controls for s in segments])
        assert file[names.STATES_DATASET].shape == (3, 6, 0)
        assert file.attrs[names.SYSTEM_ATTRIBUTE] == "rig"
        assert file.attrs[names.RENDERER_ATTRIBUTE] == "r"
        assert file.attrs[names.ACTUATED_ATTRIBUTE]
        assert json.loads(file[names.PARAMETERS_DATASET][1]) == {
            "trajectory": "rig/1",
            "epoch": "c" * 16,
            "seq": 6,
            "dt": pytest.approx(0.04996),
        }


def test_a_user_knows_better(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "a.h5")
    spool.begin()
    spool.add(segment(0, dt=0.0, p=0), "")
    with pytest.raises(ValueError, match=r"the frames came all at once.*give --dt"):
        spool.join()
    header = spool.join("crane", 0.1).header
    assert (header.system, header.dt, header.control_size) == ("crane", 0.1, 0)


def test_what_was_cut_off_in_mid_write_is_no_segment(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "a.h5")
    spool.begin()
    spool.add(segment(0), "")
    whole = spool.files[0].read_bytes()
    (spool.folder / "00000001.h5.partial").write_bytes(whole[: len(whole) // 2])
    again = Spool(tmp_path / "a.h5")
    with pytest.raises(ValueError, match="another koop-record is writing"):
        again.resume()
    spool.close()
    again.resume()
    assert again.join().count == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"precious")
    with pytest.raises(ValueError, match=r"a\.h5 exists already; choose another --out"):
        Spool(tmp_path / "a.h5")
    left = Spool(tmp_path / "b.h5")
    left.begin()
    left.add(segment(0), "")
    with pytest.raises(ValueError, match=r"1 segments of a recording that did not end.*--recover"):
        Spool(tmp_path / "b.h5").begin()


def test_there_must_be_something_to_recover(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no segment to recover in .*a\.h5\.segments"):
        Spool(tmp_path / "a.h5").resume()
