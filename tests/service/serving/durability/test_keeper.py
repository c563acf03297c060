"""Storing and telling: nothing is called durable before it is, and a full disk stops nobody."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from koop_protocol import Durable, decode, durable_key
from koop_service.serving.durability.keeper import Keeper, Snapshot
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.durability.store import Claim, StoreError
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.sharding.ownership import EVERY_SHARD
from koop_service.serving.trajectories.sealing import unseal

EPOCH = "00000000000000aa"


class Fickle(LmdbStore):
    """A store on a disk that is full at times; it writes down what happens."""

    is_full = False

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.events: list[str] = []

    def save(self, claim: Claim, records: Mapping[str, bytes]) -> None:
        self.events.append(f"save {' '.join(records)}")
        if self.is_full:
            raise StoreError("no space left on device")
        super().save(claim, records)
        self.events.append("saved")


class Bench:
    """A keeper at work, and what it told sources."""

    def __init__(self, store: Fickle) -> None:
        self.store, self.metrics = store, Metrics()
        self.claim = store.claim("me", EVERY_SHARD)
        self.keeper = Keeper(store, self.claim, self.put, self.metrics)
        self.told: dict[str, Durable] = {}

    def put(self, key: str, payload: bytes) -> None:
        message = decode(payload)
        assert isinstance(message, Durable)
        assert key == durable_key(message.trajectory)
        self.told[message.trajectory] = message
        self.store.events.append(f"tell {message.trajectory}")

    def store_one(self, name: str, number: int, *, logged: bool = True) -> None:
        durable = Durable(name, EPOCH, number) if logged else None
        self.keeper.hand_over({name: Snapshot({"number": number}, durable)})
        self.keeper.wait()

    def stored(self) -> dict[str, int]:
        return {n: unseal(r)["number"] for n, r in self.store.load(EVERY_SHARD).items()}


@contextmanager
def at_work(folder: Path) -> Iterator[Bench]:
    with closing(Fickle(folder)) as store:
        bench = Bench(store)
        bench.keeper.start()
        try:
            yield bench
        finally:
            bench.keeper.stop()


def test_a_source_is_told_after_the_transaction_and_only_if_it_keeps_a_log(tmp_path: Path) -> None:
    with at_work(tmp_path) as bench:
        bench.store_one("a", 7)
        bench.store_one("b", 8, logged=False)
    assert bench.store.events == ["save a", "saved", "tell a", "save b", "saved"]
    assert bench.told == {"a": Durable("a", EPOCH, 7)}
    with closing(LmdbStore(tmp_path)) as store:
        assert sorted(store.load(EVERY_SHARD)) == ["a", "b"]


def test_a_full_disk_is_told_and_the_failed_ones_come_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING), at_work(tmp_path) as bench:
        bench.store_one("a", 1)
        bench.store.is_full = True
        bench.store_one("a", 2)
        bench.store_one("b", 2)
        assert not bench.keeper.is_durable
        assert bench.keeper.take_failed() == {"a", "b"}
        assert bench.keeper.take_failed() == set()
        assert bench.stored() == {"a": 1}
        bench.store.is_full = False
        bench.store_one("b", 3)
        assert bench.keeper.is_durable
        assert bench.stored() == {"a": 1, "b": 3}
    assert bench.told == {"a": Durable("a", EPOCH, 1), "b": Durable("b", EPOCH, 3)}
    assert "nothing is durable at present: no space left on device" in caplog.text
    assert "states are stored again" in caplog.text
    assert bench.metrics.value("koop_unstored_total") == 2
    assert bench.metrics.value("koop_snapshots_total") == 2


def test_who_is_fenced_never_writes_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR), at_work(tmp_path) as bench:
        bench.store_one("a", 1)
        bench.store.claim("successor", EVERY_SHARD)
        bench.store_one("a", 2)
        bench.store_one("a", 3)
        assert bench.stored() == {"a": 1}
    assert bench.keeper.is_fenced
    assert bench.told["a"].seq == 1
    assert bench.store.events.count("save a") == 2, "it tries no more once it knows"
    assert "successor has claimed" in caplog.text


def test_stopping_stores_what_was_handed_over(tmp_path: Path) -> None:
    with at_work(tmp_path) as bench:
        bench.keeper.hand_over({"a": Snapshot({"number": 1}, Durable("a", EPOCH, 1))})
    assert bench.told["a"].seq == 1


def test_a_source_that_cannot_be_told_stops_nobody(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(Fickle(tmp_path)) as store:

        def broken(*_: object) -> None:
            raise OSError("the session is closed")

        keeper = Keeper(store, store.claim("me", EVERY_SHARD), broken, Metrics())
        keeper.start()
        for number in range(2):
            keeper.hand_over({"a": Snapshot({"n": number}, Durable("a", EPOCH, number))})
        keeper.stop()
        assert unseal(store.load(EVERY_SHARD)["a"])["n"] == 1
    assert "could not be told" in caplog.text
