"""What the pipeline hears of who comes and goes, and of sources' logs; and what it asks of them."""

from __future__ import annotations

from dataclasses import dataclass

from koop_protocol import ReplayQuery


@dataclass(frozen=True, slots=True)
class Presence:
    """An owner of tasks came (`here`) or went."""

    owner: str
    here: bool


@dataclass(frozen=True, slots=True)
class LogPresence:
    """A trajectory's log can be asked from now on (`here`), or no longer."""

    trajectory: str
    here: bool


@dataclass(frozen=True, slots=True)
class LogQuestion:
    """A question for a trajectory's log; `number` tells it from all others."""

    number: int
    trajectory: str
    query: ReplayQuery


@dataclass(frozen=True, slots=True)
class LogAnswer:
    """What came back: the reply's bytes, or None, and why there is none.

    late: nothing came in time, which may be the link's fault: who is held back cannot answer.
    """

    question: LogQuestion
    payload: bytes | None
    problem: str = ""
    late: bool = False


LogNews = LogPresence | LogAnswer
