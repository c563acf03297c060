"""When trajectories are copied: all that changed, a few at a time, and again where it failed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from koop_protocol import Durable, Frame, decode, durable_key
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.weights import ModelCard, save_weights
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.durability.archive import Archive
from koop_service.serving.durability.keeper import Keeper
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.durability.snapshotter import Snapshotter
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.sharding.ownership import EVERY_SHARD
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.sealing import unseal

from .test_keeper import Fickle

PICTURE, EPOCH = np.zeros((64, 64), np.uint8), "00000000000000aa"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "m.safetensors"
    save_weights(path, initialised(8, 0), ModelCard("test", "test", 0.05))
    return path


class Bench:
    """A snapshotter with a clock of its own that every copy moves, and what is stored."""

    def __init__(self, model: Path, store: Fickle, every: float) -> None:
        self.now, self.store = 0.0, store
        metrics = Metrics()
        catalogue = Catalogue([ModelEntry("test", model, ("*",))])
        self.registry = Registry(catalogue, EstimatorChoices(), Refusals(metrics), 100)
        self.told: dict[str, bytes] = {}
        claim = store.claim("me", EVERY_SHARD)
        self.keeper = Keeper(store, claim, self.told.__setitem__, metrics)
        self.snapshots = Snapshotter(
            self.registry, self.keeper, Archive(store.find), self.is_logged, every, self.clock
        )

    def clock(self) -> float:
        self.now += 0.0005
        return self.now

    @staticmethod
    def is_logged(name: str) -> bool:
        return name == "cart/0"

    def fold(self, *numbers: int, seq: int = 0) -> None:
        for number in numbers:
            frame = Frame(f"cart/{number}", EPOCH, seq, 0, PICTURE, "test")
            trajectory = self.registry.admit(frame)
            trajectory.fold_frame(frame, np.full(8, float(seq)))
            self.snapshots.note([trajectory])

    def round(self) -> int:
        """Steps until all that is due is stored."""
        self.snapshots.step()
        steps = 1
        while self.snapshots.is_busy:
            self.snapshots.step()
            steps += 1
        self.keeper.wait()
        return steps

    def stored(self) -> dict[str, int]:
        """The next number of each, as it is on disk."""
        records = {n: unseal(r) for n, r in self.store.load(EVERY_SHARD).items()}
        return {n: r["stream"]["order"]["next_seq"] for n, r in records.items()}


@contextmanager
def bench_in(folder: Path, model: Path, every: float = 3.0) -> Iterator[Bench]:
    with closing(Fickle(folder)) as store:
        bench = Bench(model, store, every)
        bench.keeper.start()
        try:
            yield bench
        finally:
            bench.keeper.stop()


def test_a_round_stores_what_has_changed_since_the_last(tmp_path: Path, model: Path) -> None:
    with bench_in(tmp_path, model) as bench:
        bench.fold(0, 1, 2)
        bench.round()
        assert bench.stored() == {}, "not yet"
        bench.now += 3.0
        bench.round()
        assert bench.stored() == {"cart/0": 1, "cart/1": 1, "cart/2": 1}
        bench.fold(1, seq=1)
        bench.now += 3.0
        bench.round()
        assert bench.store.events[-2] == "save cart/1"
        assert bench.stored()["cart/1"] == 2
        events = len(bench.store.events)
        bench.now += 3.0
        bench.round()
        assert len(bench.store.events) == events, "nothing changed"


def test_what_was_caught_up_is_stored_at_once_and_later_rounds_keep_their_time(
    tmp_path: Path, model: Path
) -> None:
    with bench_in(tmp_path, model) as bench:
        bench.fold(0)
        bench.snapshots.hasten()
        bench.round()
        assert bench.stored() == {"cart/0": 1}
        bench.fold(0, seq=1)
        bench.snapshots.hasten()
        bench.round()
        assert bench.stored() == {"cart/0": 1}
        bench.now += 3.0
        bench.round()
        assert bench.stored() == {"cart/0": 2}


def test_only_who_keeps_a_log_is_told_from_where_it_must(tmp_path: Path, model: Path) -> None:
    with bench_in(tmp_path, model) as bench:
        bench.fold(0, 1)
        bench.fold(0, seq=1)
        bench.snapshots.finish()
    (key, payload), *others = bench.told.items()
    assert not others
    assert key == durable_key("cart/0")
    assert decode(payload) == Durable("cart/0", EPOCH, 1)


def test_many_are_copied_a_few_at_a_time(tmp_path: Path, model: Path) -> None:
    with bench_in(tmp_path, model) as bench:
        bench.fold(*range(50))
        bench.now += 3.0
        assert bench.round() > 10
        assert len(bench.stored()) == 50
        assert bench.store.events.count("saved") == 1, "one transaction a round"


def test_between_two_copies_somebody_else_may_run(tmp_path: Path, model: Path) -> None:
    with bench_in(tmp_path, model) as bench:
        bench.fold(*range(50))
        bench.now += 3.0
        bench.snapshots.step()
        bench.snapshots.step()
        assert bench.snapshots.is_busy
        assert 0.0 < bench.snapshots.pause() <= 0.001
        bench.now += 0.001
        assert bench.snapshots.pause() == 0.0


def test_what_changes_while_it_is_due_is_stored_as_it_is_when_copied(
    tmp_path: Path, model: Path
) -> None:
    with bench_in(tmp_path, model) as bench:
        bench.fold(*range(30))
        bench.now += 3.0
        bench.snapshots.step()
        bench.snapshots.step()
        assert bench.snapshots.is_busy
        bench.fold(0, 29, seq=1)
        bench.round()
        first = bench.stored()
        assert sorted({first["cart/0"], first["cart/29"]}) == [1, 2]
        bench.now += 3.0
        bench.round()
        assert (bench.stored()["cart/0"], bench.stored()["cart/29"]) == (2, 2)


def test_what_could_not_be_stored_comes_again(tmp_path: Path, model: Path) -> None:
    with bench_in(tmp_path, model) as bench:
        bench.fold(0, 1)
        bench.store.is_full = True
        bench.now += 3.0
        bench.round()
        bench.now += 3.0
        bench.round()
        assert bench.stored() == {}
        assert bench.snapshots.age() > 3.0
        bench.store.is_full = False
        bench.fold(2)
        bench.now += 3.0
        bench.round()
        assert sorted(bench.stored()) == ["cart/0", "cart/1", "cart/2"]


def test_the_age_is_that_of_the_oldest_change_not_stored(tmp_path: Path, model: Path) -> None:
    with bench_in(tmp_path, model) as bench:
        assert bench.snapshots.age() < 0.1
        bench.fold(0)
        bench.now += 2.0
        bench.fold(1)
        assert 2.0 <= bench.snapshots.age() < 2.2
        bench.now += 1.0
        bench.round()
        assert bench.snapshots.age() < 0.1


def test_without_rounds_everything_is_stored_at_the_end(tmp_path: Path, model: Path) -> None:
    with bench_in(tmp_path, model, every=0) as bench:
        bench.fold(0, 1)
        bench.now += 1e6
        bench.round()
        assert bench.stored() == {}
        bench.snapshots.finish()
    with closing(LmdbStore(tmp_path)) as store:
        assert len(store.load(EVERY_SHARD)) == 2
