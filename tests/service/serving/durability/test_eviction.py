"""Trajectories leave memory and come back with the same bits, however often."""

from __future__ import annotations

import gc
import tempfile
import weakref
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_protocol import Ending, Frame, ProtocolError
from koop_service.serving.trajectories.records import snapshot_of
from koop_service.serving.trajectories.sealing import seal

from .archived import House, housed, write_model

NAMES = "abcde"
MODEL = write_model(Path(tempfile.mkdtemp(prefix="koop-test-")))


def code_of(name: str, seq: int) -> np.ndarray:
    return np.random.default_rng([ord(name[0]), seq]).normal(size=8)


def records(house: House, names: str = NAMES) -> dict[str, bytes]:
    """What is known of each, brought back where it has left."""
    found = {name: house.registry.find(name) for name in names}
    return {name: seal(snapshot_of(t)) for name, t in found.items() if t is not None}


steps = st.lists(
    st.tuples(st.sampled_from(NAMES), st.integers(1, 4), st.sampled_from([0.0, 0.3, 1.5, 20.0])),
    max_size=40,
)


@settings(max_examples=20, deadline=None)
@given(steps, st.integers(1, 3))
def test_whoever_leaves_comes_back_with_the_same_bits(script: list, most: int) -> None:
    """Frames in a row of one of five, then a pause: some leave for want of room, some idle."""
    always = House(MODEL, len(NAMES), None)
    seqs = dict.fromkeys(NAMES, 0)
    with (
        tempfile.TemporaryDirectory() as folder,
        housed(Path(folder), MODEL, most, after=10.0) as house,
    ):
        for name, frames, pause in script:
            for seq in range(seqs[name], seqs[name] + frames):
                always.show(name, seq, code_of(name, seq))
                house.show(name, seq, code_of(name, seq))
            seqs[name] += frames
            house.turn(pause)
            assert len(house.registry) <= most
        expected = records(always)
        assert {n: records(house, n)[n] for n in expected} == expected


def test_many_pass_through_few_places(tmp_path: Path) -> None:
    """Every frame but the first finds its trajectory on its way to the disk, or there."""
    many, few, rounds = 300, 10, 3
    with housed(tmp_path, MODEL, few) as house:
        for seq in range(rounds):
            for number in range(many):
                name = f"{number}/t"
                trajectory = house.show(name, seq, code_of(name, seq))
                assert trajectory.stream.frames == seq + 1
                house.turn(0.01)
        assert len(house.registry) == few
        assert house.metrics.value("koop_evicted_total") == rounds * many - few
        assert house.metrics.value("koop_revived_total") == (rounds - 1) * many
        (bank,) = {trajectory.bank for trajectory in house.registry}
        assert len(bank) == few


def test_what_left_is_there_after_a_restart(tmp_path: Path) -> None:
    with housed(tmp_path, MODEL, 1) as house:
        for name in NAMES:
            house.show(name, 0, code_of(name, 0))
        expected = records(house)
        house.snapshotter.finish()
    with housed(tmp_path, MODEL, 1) as house:
        assert records(house) == expected


def test_the_idle_leave_and_the_others_stay(tmp_path: Path) -> None:
    with housed(tmp_path, MODEL, 9, after=10.0) as house:
        house.show("a", 0, code_of("a", 0))
        house.show("b", 0, code_of("b", 0))
        house.turn(6.0)
        house.registry.find("a")  # a query is a use
        house.registry.held("b")  # one by wildcard is none
        house.turn(6.0)
        assert house.registry.names() == ["a"]
        assert house.ends == [("b", "0" * 16, 1, Ending.evicted)]
        assert house.registry.find("b") is not None


def test_where_somebody_controls_nobody_else_takes_the_place(tmp_path: Path) -> None:
    with housed(tmp_path, MODEL, 2) as house:
        for name in "abc":
            house.tasks.add("a")
            house.show(name, 0, code_of(name, 0))
        assert house.registry.names() == ["a", "c"]
        house.tasks.add("c")
        with pytest.raises(ProtocolError, match="2 trajectories are here already"):
            house.show("d", 0, code_of("d", 0))
        assert house.registry.names() == ["a", "c"]


def test_where_memory_is_short_a_further_one_takes_a_place(tmp_path: Path) -> None:
    with housed(tmp_path, MODEL, 9) as house:
        house.show("a", 0, code_of("a", 0))
        house.pressed = True
        house.show("b", 0, code_of("b", 0))
        assert house.registry.names() == ["b"]


def test_without_an_archive_a_further_one_is_refused() -> None:
    house = House(MODEL, 1, None)
    house.show("a", 0, code_of("a", 0))
    with pytest.raises(ProtocolError, match="1 trajectories are here already"):
        house.show("b", 0, code_of("b", 0))


def test_a_frame_that_is_refused_costs_nobody_a_place(tmp_path: Path) -> None:
    with housed(tmp_path, MODEL, 1) as house:
        house.show("a", 0, code_of("a", 0))
        with pytest.raises(ProtocolError, match="has shape"):
            house.registry.admit(Frame("b", "0" * 16, 0, 0, np.zeros((8, 8), np.uint8), "test"))
        assert house.registry.names() == ["a"]


def test_a_disk_that_cannot_be_read_does_not_begin_anew(tmp_path: Path) -> None:
    with housed(tmp_path, MODEL, 1) as house:
        for name in "ab":
            house.show(name, 0, code_of(name, 0))
        house.snapshotter.finish()
        house.keeper.wait()
        house.snapshotter.finish()  # learns that it is stored
        store = house.keeper._store
        store.close()
        path = next(tmp_path.glob("*.lmdb"))
        path.rename(tmp_path / "away")
        path.mkdir()
        with pytest.raises(ProtocolError, match="cannot be read at present"):
            house.show("a", 1, code_of("a", 1))
        path.rmdir()
        (tmp_path / "away").rename(path)
        assert house.show("a", 1, code_of("a", 1)).stream.frames == 2


def test_who_leaves_needs_no_collection_of_garbage(tmp_path: Path) -> None:
    with housed(tmp_path, MODEL, 1) as house:
        there = weakref.ref(house.show("a", 0, np.zeros(8)))
        stream = weakref.ref(house.show("a", 1, np.ones(8)).stream)
        gc.disable()
        try:
            house.show("b", 0, np.zeros(8))
            house.snapshotter.finish()
            assert house.registry.held("a") is None
            assert there() is None
            assert stream() is None
        finally:
            gc.enable()
