"""The state folder: what is stored comes back, and nothing damaged is ever opened."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koop_service.serving.snapshots import SnapshotStore

RECORD = {
    "number": 7,
    "names": ["a", "b"],
    "nothing": None,
    "nested": {"R": np.arange(12.0).reshape(3, 4), "empty": np.zeros((0, 5))},
    "list": [(1, np.array([np.pi]))],
}


def stored(folder: Path) -> SnapshotStore:
    store = SnapshotStore(folder)
    store.prepare()
    store.save({f"cart/{i}": RECORD for i in range(300)})
    return store


def test_records_come_back_bit_for_bit(tmp_path: Path) -> None:
    records = stored(tmp_path / "new" / "folder").load()
    assert len(records) == 300
    record = records["cart/7"]
    assert (record["number"], record["names"], record["nothing"]) == (7, ["a", "b"], None)
    np.testing.assert_array_equal(record["nested"]["R"], RECORD["nested"]["R"])
    assert record["nested"]["empty"].shape == (0, 5)
    assert record["list"][0][1][0] == np.pi


def test_saving_replaces_everything(tmp_path: Path) -> None:
    store = stored(tmp_path)
    store.save({"cart/x": {"a": 1}})
    assert store.load() == {"cart/x": {"a": 1}}
    store.save({})
    assert store.load() == {}


def test_a_folder_that_cannot_be_made_is_explained(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="--state-folder"):
        SnapshotStore(tmp_path / "file" / "state").prepare()


def test_an_empty_folder_holds_nothing(tmp_path: Path) -> None:
    assert SnapshotStore(tmp_path).load() == {}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("state")
    stored(folder)
    return folder / "estimators.lmdb"


@given(st.data())
def test_a_damaged_file_is_left_out(file: Path, data: st.DataObject) -> None:
    """Cut short, or with a byte changed anywhere: LMDB itself might crash on some of these."""
    whole = file.read_bytes()
    position = data.draw(st.integers(0, len(whole) - 1))
    damaged = whole[:position]
    if data.draw(st.booleans()):
        damaged += bytes([whole[position] ^ 0x55]) + whole[position + 1 :]
    try:
        file.write_bytes(damaged)
        assert SnapshotStore(file.parent).load() == {}
    finally:
        file.write_bytes(whole)
    assert len(SnapshotStore(file.parent).load()) == 300


def test_a_file_without_its_digest_is_left_out(tmp_path: Path, caplog) -> None:
    store = stored(tmp_path)
    (tmp_path / "estimators.lmdb.blake2b").unlink()
    assert store.load() == {}
    assert "left out" in caplog.text
