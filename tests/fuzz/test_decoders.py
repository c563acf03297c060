"""Every decoder under a bounded number of bad inputs, the same each time.

`benchmarks/fuzz.py` runs the same targets by hand, guided by coverage, for as long as one likes.
"""

from __future__ import annotations

from pathlib import Path
from random import Random

import msgpack
import pytest
from fuzzing.catalogue import CORPUS, FILES, WIRE, corpus, first_of, guard_of, seeds_of
from fuzzing.engines import inputs
from fuzzing.guard import BrokenError, Guard
from fuzzing.mutation import mutated

MESSAGES, FILE_INPUTS = 4000, 300


@pytest.mark.parametrize("name", [*WIRE, *FILES])
def test_good_inputs_are_taken(name: str) -> None:
    guard = guard_of(name)
    for data in first_of(name):
        guard(data)
    assert guard.accepted == guard.runs > 0


@pytest.mark.parametrize("name", [*WIRE, *FILES])
def test_what_was_found_once_breaks_nothing(name: str) -> None:
    guard = guard_of(name)
    guard.stride = 1
    for data in seeds_of(name):
        guard(data)


@pytest.mark.parametrize("name", [*WIRE, *FILES])
def test_bad_inputs_break_nothing(name: str) -> None:
    guard, runs = guard_of(name), MESSAGES if name in WIRE else FILE_INPUTS
    mutants = inputs(seeds_of(name), Random(name))
    while guard.runs < runs:
        guard(next(mutants))
    assert 0 < guard.accepted < runs, "the mutants are all good, or all bad"


def test_a_mutant_differs_and_depends_on_the_seed_alone() -> None:
    good = first_of("message")[0]
    mutants = [mutated(good, Random(seed)) for seed in range(200)]
    assert mutants == [mutated(good, Random(seed)) for seed in range(200)]
    assert len(set(mutants)) > 150
    trees = 0
    for data in mutants:
        try:
            trees += msgpack.unpackb(data) != msgpack.unpackb(good)
        except Exception:
            continue
    assert trees > 50, "hardly a mutant is msgpack still"


def test_what_takes_too_much_memory_is_told() -> None:
    guard = Guard(lambda _: bool(bytearray(1 << 20)), stride=1)
    with pytest.raises(BrokenError, match="of memory"):
        guard(b"x")


def test_what_takes_too_long_is_told() -> None:
    guard = Guard(lambda _: sum(range(100_000)) > 0, seconds=0.0)
    with pytest.raises(BrokenError, match="of the processor"):
        guard(b"x")


def test_the_corpus_is_small_and_of_known_targets() -> None:
    assert set(corpus()) <= {*WIRE, *FILES}
    assert CORPUS.stat().st_size < 300_000 if Path(CORPUS).exists() else True
