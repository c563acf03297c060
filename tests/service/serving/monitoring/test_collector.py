"""What lives long is not gone through again and again, and nothing stays for ever because of it."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from koop_service.serving.monitoring import collector


class Node:
    """Something that can be part of a cycle."""

    def __init__(self) -> None:
        self.other: object = None


@pytest.fixture(autouse=True)
def thawed() -> Iterator[None]:
    gc.unfreeze()
    yield
    gc.unfreeze()


def test_what_outlives_a_full_collection_is_left_out_of_the_next() -> None:
    callbacks = gc.callbacks[:]
    with collector.sparing():
        before = gc.get_freeze_count()
        kept = [Node() for _ in range(1000)]
        gc.collect(1)
        assert gc.get_freeze_count() == before
        gc.collect()
        assert gc.get_freeze_count() >= before + len(kept)
        assert not any(isinstance(found, Node) for found in gc.get_objects())
    assert gc.get_freeze_count() == 0
    assert gc.callbacks == callbacks


def test_a_cycle_that_was_left_out_is_found_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collector, "_WHOLE", 3)
    with collector.sparing():
        node = Node()
        node.other = node
        there = weakref.ref(node)
        gc.collect()
        del node
        gc.collect()
        assert there() is not None
        gc.collect()
        assert there() is None
