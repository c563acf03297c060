"""What every snapshot store does: subclass `StoreContract` with a fixture `store` that is empty."""

from __future__ import annotations

import threading

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from koop_protocol import shard_of
from koop_service.serving.durability.store import Claim, FencedError, SnapshotStore
from koop_service.serving.sharding.ownership import EVERY_SHARD

names = st.from_regex(r"[a-z0-9]{1,3}(/[A-Z_.-]{1,40}){0,2}", fullmatch=True)
records = st.dictionaries(names, st.binary(max_size=200), max_size=8)


_SHARED = [HealthCheck.function_scoped_fixture, HealthCheck.differing_executors]
"""One store serves all examples, which is why each begins by emptying it; and each kind of store
runs the same test."""


def name_of(shard: str) -> str:
    return next(f"cart/{i}" for i in range(10_000) if shard_of(f"cart/{i}") == shard)


class StoreContract:
    """The tests; `store` is a new one."""

    @given(st.lists(records, max_size=4))
    @settings(max_examples=30, deadline=None, suppress_health_check=_SHARED)
    def test_what_was_saved_last_is_loaded(
        self, store: SnapshotStore, batches: list[dict[str, bytes]]
    ) -> None:
        claim = store.claim("me", EVERY_SHARD)
        store.delete(claim, list(store.load(EVERY_SHARD)))
        expected: dict[str, bytes] = {}
        for batch in batches:
            store.save(claim, batch)
            expected |= batch
        assert store.load(EVERY_SHARD) == expected
        for shard in {shard_of(name) for name in expected}:
            of_shard = {n: r for n, r in expected.items() if shard_of(n) == shard}
            assert store.load([shard]) == of_shard
        assert store.load([]) == {}
        assert {name: store.find(name) for name in expected} == expected
        assert len(store.load(EVERY_SHARD, 2)) == min(2, len(expected))

    def test_a_record_is_found_while_another_thread_saves(self, store: SnapshotStore) -> None:
        claim = store.claim("me", EVERY_SHARD)
        store.save(claim, {"a": b"1"})
        assert store.find("never/there") is None
        batches = [{f"b/{i}/{k}": bytes(2_000_000) for k in range(20)} for i in range(4)]
        saving = threading.Thread(target=lambda: [store.save(claim, batch) for batch in batches])
        saving.start()
        while saving.is_alive():
            assert store.find("a") == b"1"
        saving.join()
        assert store.find("b/3/19") == bytes(2_000_000)

    def test_a_deleted_record_is_gone_and_the_others_are_not(self, store: SnapshotStore) -> None:
        claim = store.claim("me", EVERY_SHARD)
        store.save(claim, {"a": b"1", "b": b"2"})
        store.delete(claim, ["a", "never/there"])
        assert store.load(EVERY_SHARD) == {"b": b"2"}

    def test_who_is_silent_is_told_by_shard(self, store: SnapshotStore) -> None:
        old, new, other = name_of("00"), name_of("01"), name_of("02")
        claim = store.claim("me", EVERY_SHARD)
        store.save(claim, {old: b"1", other: b"1"})
        assert store.silent(EVERY_SHARD, 3600.0) == []
        assert sorted(store.silent({"00", "01"}, 0.0)) == [old]
        store.save(claim, {new: b"1"})
        assert sorted(store.silent({"00", "01"}, 0.0)) == sorted([old, new])
        store.delete(claim, [old])
        assert store.silent({"00", "01"}, 0.0) == [new]
        assert store.silent([], 0.0) == []

    def test_a_large_batch_fits(self, store: SnapshotStore) -> None:
        claim = store.claim("me", EVERY_SHARD)
        batch = {f"cart/{i}": bytes(500_000) for i in range(300)}
        store.save(claim, batch)
        assert store.load(EVERY_SHARD) == batch

    def test_epochs_only_rise(self, store: SnapshotStore) -> None:
        first = store.claim("a", {"00", "01"})
        second = store.claim("b", {"01", "02"})
        third = store.claim("c", {"02", "00"})
        assert first.epoch < second.epoch < third.epoch
        assert (third.owner, third.shards) == ("c", {"00", "02"})

    def test_the_former_owner_writes_nothing_any_more(self, store: SnapshotStore) -> None:
        lost, kept = name_of("00"), name_of("01")
        former = store.claim("former", EVERY_SHARD)
        store.save(former, {lost: b"1"})
        newer = store.claim("newer", {"00"})
        with pytest.raises(FencedError, match="newer has claimed the shards 00 from former") as e:
            store.save(former, {kept: b"2", lost: b"2"})
        assert (e.value.shards, e.value.newer.epoch) == ({"00"}, newer.epoch)
        with pytest.raises(FencedError):
            store.delete(former, [lost])
        assert store.load(EVERY_SHARD) == {lost: b"1"}, "a part of a refused batch was written"
        store.save(former, {kept: b"3"})
        store.save(newer, {lost: b"3"})
        assert store.load(EVERY_SHARD) == {lost: b"3", kept: b"3"}

    def test_the_same_owner_s_former_claim_is_no_claim(self, store: SnapshotStore) -> None:
        former = store.claim("me", EVERY_SHARD)
        store.claim("me", EVERY_SHARD)
        with pytest.raises(FencedError):
            store.save(former, {"a": b"1"})

    def test_an_unclaimed_shard_is_the_caller_s_mistake(self, store: SnapshotStore) -> None:
        claim = store.claim("me", {"00"})
        with pytest.raises(ValueError, match="me writes to the shards 01"):
            store.save(claim, {name_of("01"): b"1"})
        made_up = Claim("me", claim.epoch, EVERY_SHARD)
        with pytest.raises(FencedError):
            store.save(made_up, {name_of("01"): b"1"})
