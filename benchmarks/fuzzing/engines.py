"""Two ways to look for an input that breaks a target: at random, and guided by coverage.

At random is what the test suite does: the same seed gives the same inputs everywhere. Guided is
atheris (libFuzzer): it keeps inputs that reach a new branch of koop's Python code, and needs its
wheel (`pip install '.[fuzz]'`, Linux on x86).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

from fuzzing.catalogue import guard_of, seeds_of
from fuzzing.guard import Guard
from fuzzing.mutation import mutated, spliced

Report = Callable[[Guard], None]

_REPORT_EVERY = 256
_INSTRUMENTED = (
    "koop_protocol",
    "koop_service.encoding",
    "koop_service.serving",
    "koop_service.learning.recording",
    "koop_service.estimation.stream",
    "koop_service.estimation.join",
    "koop_service.estimation.reorder",
)


def inputs(seeds: list[bytes], random: Random) -> Iterator[bytes]:
    """The seeds, then mutants of them without end."""
    yield from seeds
    while True:
        data = random.choice(seeds)
        if random.random() < 0.1:
            data = spliced(data, random.choice(seeds), random)
        yield mutated(data, random)


def at_random(
    guard: Guard, seeds: list[bytes], runs: int, seconds: float, seed: int, report: Report
) -> bytes | None:
    """The first input that breaks the target, with what it raised shown; None if there is none."""
    deadline = time.monotonic() + seconds
    for data in inputs(seeds, Random(seed)):
        try:
            guard(data)
        except Exception:
            sys.excepthook(*sys.exc_info())
            return data
        if guard.runs % _REPORT_EVERY == 0:
            report(guard)
        if guard.runs >= runs or time.monotonic() > deadline:
            report(guard)
            return None
    raise AssertionError("unreachable: the inputs never end")


def guided(name: str, folder: Path, runs: int, seconds: float, seed: int, report: Report) -> None:
    """Run libFuzzer on the inputs in `folder`, and exit the process as it does.

    New inputs are kept in `folder`; one that breaks the target is left beside it, in `crash-...`.
    """
    import atheris

    # Not what numba compiles: it cannot read what atheris makes of a function.
    with atheris.instrument_imports(include=list(_INSTRUMENTED)):
        guard = guard_of(name)

    def look_at(data: bytes) -> None:
        guard(data)
        if guard.runs % _REPORT_EVERY == 0:
            report(guard)

    seeds = seeds_of(name)

    def change(data: bytes, largest: int, number: int) -> bytes:
        if number % 2:
            return atheris.Mutate(data, largest)
        # What libFuzzer keeps is mostly refused early: begin with something good as often.
        random = Random(number)
        return mutated(random.choice((data, random.choice(seeds))), random, largest)

    options = [
        *(f"-runs={runs}", f"-max_total_time={int(seconds)}", f"-seed={seed or 1}"),
        *("-max_len=32768", "-timeout=20", "-rss_limit_mb=4096", "-verbosity=0"),
        f"-artifact_prefix={folder.parent}/",
    ]
    atheris.Setup([sys.argv[0], *options, str(folder)], look_at, custom_mutator=change)
    atheris.Fuzz()
