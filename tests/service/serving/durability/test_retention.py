"""Old states are deleted, but not those of trajectories that are there, or somebody else's."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from integration.loopback import wait_until

from koop_service.serving.durability.keeper import Keeper, Snapshot
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.durability.retention import Retention
from koop_service.serving.durability.store import Claim, FencedError
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.sharding.ownership import EVERY_SHARD

from .store_contract import name_of

DAY = 86400.0
START = 2e9  # a date that only a clock that is set shows


class Bench:
    """A store with three records, the calendar and the clock."""

    def __init__(self, folder: Path) -> None:
        self.date, self.now, self.here = START, 0.0, {"b"}
        self.store = LmdbStore(folder, lambda: self.date)
        self.claim = self.store.claim("me", EVERY_SHARD)
        self.metrics = Metrics()
        self.store.save(self.claim, {"a": b"1", "b": b"1", "c": b"1"})

    def retention(self, days: float, claim: Claim | None = None) -> Retention:
        return Retention(
            self.store,
            claim or self.claim,
            DAY * days,
            self.here.__contains__,
            self.metrics,
            lambda: self.now,
        )

    def left(self) -> list[str]:
        return sorted(self.store.load(EVERY_SHARD))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    with closing(bench.store):
        yield bench


def test_what_is_silent_for_so_long_is_deleted_unless_it_is_in_memory(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    retention = bench.retention(days=30)
    bench.date = START + 29 * DAY
    retention.step()
    assert bench.left() == ["a", "b", "c"]
    bench.store.save(bench.claim, {"c": b"2"})
    bench.date = START + 30 * DAY
    retention.step()
    assert bench.left() == ["a", "b", "c"], "it looks but once an hour"
    bench.now += 3600.0
    retention.step()
    assert bench.left() == ["a", "b", "c"], "the next look decides"
    bench.now += 3600.0
    with caplog.at_level(logging.INFO):
        retention.step()
    assert bench.left() == ["b", "c"]
    assert bench.metrics.value("koop_forgotten_total") == 1
    assert "1 trajectories, such as a, are deleted: nothing was heard of them for 30" in caplog.text


def test_a_calendar_that_is_wrong_for_a_while_deletes_nothing(bench: Bench) -> None:
    retention = bench.retention(days=30)
    for days in (400, 1, 400, -400, 2):
        bench.date = START + days * DAY
        retention.step()
        bench.now += 3600.0
    assert bench.left() == ["a", "b", "c"]


def test_by_default_nothing_is_ever_deleted(bench: Bench) -> None:
    retention = bench.retention(days=0)
    bench.date = 1e9
    retention.step()
    assert (retention.pause(), len(bench.left())) == (None, 3)


def test_who_has_lost_a_shard_deletes_nothing_of_it(bench: Bench) -> None:
    lost = name_of("00")
    bench.store.save(bench.claim, {lost: b"1"})
    bench.store.claim("successor", {"00"})
    bench.date = START + 2 * DAY
    retention = bench.retention(days=1)
    retention.step()
    bench.now += 3600.0
    with pytest.raises(FencedError):
        retention.step()
    assert lost in bench.left()
    kept = bench.store.claim("another", {"01"})
    other = bench.retention(days=1, claim=kept)
    for _ in range(2):
        other.step()
        bench.now += 3600.0
    assert {"a", "b", "c", lost} == set(bench.left()), "not of its shards"


def test_the_keeper_looks_by_itself_and_goes_on_storing(bench: Bench) -> None:
    bench.date = START + 2 * DAY
    retention = bench.retention(days=1)
    retention.step()
    bench.now += 3600.0
    keeper = Keeper(bench.store, bench.claim, lambda *_: None, bench.metrics, retention=retention)
    keeper.start()
    wait_until(lambda: bench.metrics.value("koop_forgotten_total") == 2, "two to be deleted")
    keeper.hand_over({"a": Snapshot({"number": 1}, None)})
    keeper.stop()
    assert bench.left() == ["a", "b"]
