"""Shards: shared out without a gap or an overlap, and spoken for by exactly one worker."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from koop_protocol import SHARDS, shard_of
from koop_service.serving.sharding.ownership import (
    EVERY_SHARD,
    Ownership,
    listed,
    named_shards,
    share,
    worker_shards,
)
from koop_service.serving.sharding.settings import PlacementSettings


@given(st.integers(1, SHARDS), st.text(max_size=20))
def test_every_trajectory_has_exactly_one_owner(count: int, name: str) -> None:
    workers = [Ownership(share(index, count)) for index in range(count)]
    assert frozenset().union(*(worker.shards for worker in workers)) == EVERY_SHARD
    sizes = [len(worker.shards) for worker in workers]
    assert sum(sizes) == SHARDS
    assert max(sizes) - min(sizes) <= 1
    assert sum(worker.has(name) for worker in workers) == 1
    assert sum(worker.speaks_for_all for worker in workers) == 1


def test_a_worker_listens_to_its_own_shards() -> None:
    assert Ownership().keys("koop/frame/**") == ["koop/frame/**"]
    some = Ownership(frozenset({shard_of("pendulum"), "3f"}))
    assert some.keys("koop/frame/**") == ["koop/frame/20/**", "koop/frame/3f/**"]


@given(st.sets(st.sampled_from(sorted(EVERY_SHARD)), min_size=1))
def test_shards_can_be_written_as_ranges(shards: set[str]) -> None:
    assert named_shards(listed(shards).split()) == shards


def test_the_ordinal_comes_from_the_host_s_name() -> None:
    assert worker_shards("ordinal/4", "koop-worker-2.koop.svc") == share(2, 4)
    assert worker_shards("3/4", "whatever") == share(3, 4)
    with pytest.raises(ValueError, match="ends with -NUMBER"):
        worker_shards("ordinal/4", "laptop")


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"worker": "4/4"}, "there is no worker 4 of 4; expected 0 to 3"),
        ({"worker": "one"}, "expected K/N"),
        ({"worker": "0/65"}, "expected 1 to 64"),
        ({"workers": 0}, "expected 1 to 64"),
        ({"shards": ("0-f",)}, "two hex digits"),
        ({"shards": ("40",)}, "within 00-3f"),
        ({"shards": ("1f-00",)}, "within 00-3f"),
        ({"shards": ("00",), "worker": "0/2"}, "at most one"),
        ({"ray": True}, "expected --ray --workers N"),
        ({"spares": -1}, "expected 0 or more"),
    ],
)
def test_bad_settings_are_explained(settings: dict, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        PlacementSettings(**settings)
