"""Fuzz every decoder: bad inputs by the million, under watch of exceptions, memory and time.

    python benchmarks/fuzz.py                             # each for half a minute, by coverage
    python benchmarks/fuzz.py message --seconds 36000     # one of them, for a night
    python benchmarks/fuzz.py --plain --runs 1000000      # without atheris, the same each time
    python benchmarks/fuzz.py message --input FILE        # once more what broke it

A decoder that breaks leaves the input in out/fuzz, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha1
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from fuzzing.catalogue import CORPUS, FILES, WIRE, corpus, first_of, seeds_of

NAMES = (*WIRE, *FILES)
FOREVER = 2**31 - 1
FOUND = Path("out/fuzz")
LOG = "log"
INTERRUPTED = 72  # libFuzzer's exit code after Ctrl-C
MEMORY = Path("/dev/shm")
"""Where files cost nothing: each input of some targets is written to one."""
KEPT = 400
"""Most inputs of a target that --keep writes into the corpus."""


def main() -> None:
    options = parse_options()
    if options.input:
        sys.exit(once(options))
    results = [fuzz(name, options) for name in options.targets]
    print_table(results)
    if options.json:
        print(json.dumps({r.target: r.figures() for r in results}))
    sys.exit(any(r.broken for r in results))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("targets", nargs="*", help=f"of {', '.join(NAMES)}; default: all of them")
    parser.add_argument("--seconds", type=float, help="time for each (default: 30 without --runs)")
    parser.add_argument("--runs", type=int, default=FOREVER, help="most inputs for each")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plain", action="store_true", help="at random, not guided by coverage")
    parser.add_argument(
        "--keep", action="store_true", help="put what reached new code into the corpus"
    )
    parser.add_argument("--input", type=Path, help="run one input from a file")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    options.targets = options.targets or list(NAMES)
    if unknown := set(options.targets) - set(NAMES):
        parser.error(f"no target {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    if options.seconds is None:
        options.seconds = 30.0 if options.runs == FOREVER else FOREVER
    return options


# One target


@dataclass
class Result:
    """What came of one target. resident: (inputs so far, memory [bytes]) each second."""

    target: str
    runs: int = 0
    accepted: int = 0
    slowest: float = 0.0
    largest: int = 0
    seconds: float = 0.0
    broken: Path | None = None
    resident: list[tuple[int, int]] = field(default_factory=list)

    def growth(self) -> float:
        """Resident memory gained over the second half [KB a million inputs]; 0: too short."""
        half = np.array(self.resident[len(self.resident) // 2 :], dtype=float)
        if len(half) < 10:
            return 0.0
        return float(np.polyfit(half[:, 0], half[:, 1], 1)[0]) * 1e6 / 1e3

    def figures(self) -> dict[str, Any]:
        return {
            "runs": self.runs,
            "accepted": self.accepted,
            "seconds": round(self.seconds, 1),
            "slowest_ms": round(1e3 * self.slowest, 2),
            "largest_kb": round(self.largest / 1e3, 1),
            "resident_mb": round(self.resident[-1][1] / 1e6, 1) if self.resident else 0.0,
            "growth_kb_per_million": round(self.growth(), 1),
            "broken": str(self.broken or ""),
        }


def fuzz(name: str, options: argparse.Namespace) -> Result:
    """Run one target in a process of its own, and watch that one's memory."""
    context = multiprocessing.get_context("spawn")
    counts = context.Array("d", 4)
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        inputs = Path(folder) / "corpus"
        arguments = (name, options.plain, options.runs, options.seconds, options.seed, inputs)
        process = context.Process(target=look, args=(*arguments, counts))
        started, result = time.monotonic(), Result(name)
        process.start()
        while process.exitcode is None:
            process.join(1.0)
            _sample(process.pid, counts, result)
        result.seconds = time.monotonic() - started
        result.runs, result.accepted = int(counts[0]), int(counts[1])
        result.slowest, result.largest = counts[2], int(counts[3])
        if process.exitcode not in (0, INTERRUPTED):
            result.broken = _keep_crash(name, Path(folder))
        elif options.keep and not options.plain:
            _keep_corpus(name, inputs)
    return result


def _sample(pid: int | None, counts: Any, result: Result) -> None:
    with suppress(psutil.Error):  # it may just have ended
        resident = psutil.Process(pid).memory_info().rss
        if resident:
            result.resident.append((int(counts[0]), resident))


def look(
    name: str, plain: bool, runs: int, seconds: float, seed: int, folder: Path, counts: Any
) -> None:
    """In the child: seeds into the corpus folder, then the engine until it ends or breaks."""
    from fuzzing import engines

    _log_to(folder.parent / LOG)
    tempfile.tempdir = str(folder.parent)  # libFuzzer leaves without cleaning up

    def report(guard: engines.Guard) -> None:
        counts[:] = [guard.runs, guard.accepted, guard.slowest, guard.largest]

    if not plain:
        folder.mkdir()
        for data in seeds_of(name):
            (folder / sha1(data).hexdigest()).write_bytes(data)
        engines.guided(name, folder, runs, seconds, seed, report)
    guard = engines.guard_of(name)
    broken = engines.at_random(guard, seeds_of(name), runs, seconds, seed, report)
    if broken is not None:
        (folder.parent / f"crash-{sha1(broken).hexdigest()}").write_bytes(broken)
        sys.exit(1)


def _log_to(path: Path) -> None:
    """libFuzzer writes to the process's own standard error, and much."""
    with path.open("wb") as file:
        os.dup2(file.fileno(), sys.stderr.fileno())


def _keep_crash(name: str, folder: Path) -> Path:
    """The input that broke the target, where it can be found again."""
    print((folder / LOG).read_text(encoding="utf-8", errors="replace")[-2000:])
    FOUND.mkdir(parents=True, exist_ok=True)
    crashes = sorted(folder.glob("*-*"))
    for path in crashes:
        (FOUND / path.name).write_bytes(path.read_bytes())
        print(f"{name} breaks; see it again with:", flush=True)
        print(f"  python benchmarks/fuzz.py {name} --input {FOUND / path.name}", flush=True)
    return FOUND / crashes[0].name if crashes else FOUND


def _keep_corpus(name: str, folder: Path) -> None:
    """The shortest inputs that reached something new, without the seeds."""
    found = {path.read_bytes() for path in folder.iterdir()} - set(first_of(name))
    kept = corpus()
    kept[name] = sorted((data.hex() for data in found), key=lambda line: (len(line), line))[:KEPT]
    CORPUS.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")


def once(options: argparse.Namespace) -> int:
    """Run one input, as the exit code says; what it raises is shown."""
    from fuzzing.catalogue import guard_of

    (name,) = options.targets
    guard = guard_of(name)
    guard.stride = 1
    guard(options.input.read_bytes())
    print(f"{name} {'takes' if guard.accepted else 'refuses'} it")
    return 0


def print_table(results: list[Result]) -> None:
    print(
        f"  {'':10}{'inputs':>12}{'a second':>10}{'taken':>8}{'slowest':>11}{'most memory':>13}"
        f"{'resident':>11}{'growth a million':>18}"
    )
    for result in results:
        figures = result.figures()
        print(
            f"  {result.target:10}{result.runs:12}{result.runs / max(result.seconds, 1e-9):10.0f}"
            f"{result.accepted / max(result.runs, 1):8.1%}{figures['slowest_ms']:8.1f} ms"
            f"{figures['largest_kb']:10.0f} KB{figures['resident_mb']:8.0f} MB"
            f"{figures['growth_kb_per_million']:15.0f} KB"
            f"{'   BROKEN' if result.broken else ''}"
        )


if __name__ == "__main__":
    main()
