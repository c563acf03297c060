"""Shards as a worker owns them: which ones, what it listens to, and what it answers.

A worker learns and answers for the trajectories of its own shards and is silent about all others,
so that every trajectory is answered for exactly once, however many workers hear a question.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from koop_protocol import SHARDS, ProtocolError, shard_of

EVERY_SHARD = frozenset(f"{number:02x}" for number in range(SHARDS))
"""All shards, as they stand in keys."""
_SPOKESMAN = "00"
"""Whose owner answers what concerns no shard, such as a name that is none."""

_WORKER = re.compile(r"(\d+|ordinal)/(\d+)")
_ORDINAL = re.compile(r"(?:.*-)?(\d+)")
_RANGE = re.compile(r"([0-9a-f]{2})(?:-([0-9a-f]{2}))?")


@dataclass(frozen=True)
class Ownership:
    """The shards of one worker."""

    shards: frozenset[str] = EVERY_SHARD

    @property
    def whole(self) -> bool:
        """Whether there is no other worker."""
        return self.shards == EVERY_SHARD

    @property
    def speaks_for_all(self) -> bool:
        """Whether this worker answers what concerns no trajectory: one of all workers does."""
        return _SPOKESMAN in self.shards

    def has(self, name: str) -> bool:
        """Whether questions about this trajectory are for this worker; any text is a name here."""
        try:
            return shard_of(name) in self.shards
        except ProtocolError:
            return self.speaks_for_all

    def keys(self, pattern: str) -> list[str]:
        """What of `koop/<kind>/**`, where the next chunk is the shard, concerns this worker."""
        if self.whole:
            return [pattern]
        return [pattern.replace("**", f"{shard}/**") for shard in sorted(self.shards)]


def worker_shards(text: str, host: str) -> frozenset[str]:
    """The shards of worker K of N, by `K/N` with K from 0, or by `ordinal/N`.

    Args:
        text: `1/4`, or `ordinal/4` for the number at the end of the host's name.
        host: this machine's name, such as `koop-1`, what Kubernetes calls a StatefulSet's pods.

    Raises:
        ValueError: neither, or there is no such worker.
    """
    found = _WORKER.fullmatch(text)
    if found is None:
        raise ValueError(
            f"worker is {text!r}; expected K/N, worker K (from 0) of N, such as 0/4; ordinal/N "
            "for the number that the host's name ends with; or - to be told on standard input"
        )
    index = _ordinal(host) if found[1] == "ordinal" else int(found[1])
    return share(index, int(found[2]))


def share(index: int, count: int) -> frozenset[str]:
    """The shards of worker `index` of `count`: a stretch of them, as even as can be."""
    check_count(count)
    if not 0 <= index < count:
        raise ValueError(
            f"there is no worker {index} of {count}; expected 0 to {count - 1}, since workers are "
            "counted from 0"
        )
    first, end = SHARDS * index // count, SHARDS * (index + 1) // count
    return frozenset(f"{number:02x}" for number in range(first, end))


def check_count(count: int) -> None:
    """ValueError unless so many workers can share the shards."""
    if not 1 <= count <= SHARDS:
        raise ValueError(f"{count} workers; expected 1 to {SHARDS}, as there are {SHARDS} shards")


def named_shards(ranges: Iterable[str]) -> frozenset[str]:
    """The shards of ranges such as `00-0f`, or single ones. Raises ValueError for anything else."""
    found: set[str] = set()
    for text in ranges:
        match = _RANGE.fullmatch(text)
        first, last = (match[1], match[2] or match[1]) if match else ("1", "0")
        between = {shard for shard in EVERY_SHARD if first <= shard <= last}
        if not between or last not in EVERY_SHARD:
            raise ValueError(
                f"shards has {text!r}; expected two hex digits as in keys, or a range of them, "
                f"within 00-{SHARDS - 1:02x}, such as 00-0f"
            )
        found |= between
    return frozenset(found)


def listed(shards: Iterable[str]) -> str:
    """The shards as ranges, for people: `00-14 20`."""
    ranges: list[list[int]] = []
    for number in sorted(int(shard, 16) for shard in shards):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return " ".join(f"{a:02x}" if a == b else f"{a:02x}-{b:02x}" for a, b in ranges)


def _ordinal(host: str) -> int:
    found = _ORDINAL.fullmatch(host.split(".")[0])
    if found is None:
        raise ValueError(
            f"the host is called {host!r}; expected a name that ends with -NUMBER, as in a "
            "StatefulSet, for the worker ordinal/N"
        )
    return int(found[1])
