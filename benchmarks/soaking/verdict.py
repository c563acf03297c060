"""What a soak comes to: figures, and whether the service is sound."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from load import growth

from koop_protocol import StateReply

#: Of the stream's counters, what a source that sends everything in order never causes.
TROUBLE = ("gaps", "missing_frames", "missing_controls", "duplicates", "late", "stale_epoch")
#: Errors that a good source's questions may meet.
PATIENCE = ("", "warming_up", "overloaded")
MOST_OVERLOAD = 0.01
"""Share of the questions that may be refused since too many wait: the machine is too slow."""
LEAST_MINUTES = 2.0
"""In less time memory has not settled."""
MOST_GAINED = 25e6
"""Bytes that memory may gain over the second half, however long: allocators take in steps."""


@dataclass(frozen=True)
class Sample:
    """The service at one moment: time and seconds since the start, resident bytes, counters."""

    at: float
    resident: int
    frames: float
    rejected: float
    lost: float
    waiting: float


@dataclass(frozen=True)
class Verdict:
    """The figures, and why the service is not sound."""

    figures: dict[str, Any]
    why: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        return not self.why


def judge(
    minutes: float,
    samples: list[Sample],
    found: dict[str, Any],
    states: dict[str, StateReply],
    exit_code: int,
) -> Verdict:
    """found: what the roles saw. states: of each good trajectory at the end."""
    answers, spoilt = found["answers"], found["spoilt_answers"]
    times = 1e3 * np.array([latency for _, latency in answers.latencies] or [np.nan])
    folded = {name: state.counters["frames"] for name, state in states.items()}
    trouble = sum(state.counters[name] for state in states.values() for name in TROUBLE)
    refused = {code: n for code, n in answers.codes.items() if code not in PATIENCE}
    slope = growth([(sample.at, sample.resident) for sample in samples])
    internal = answers.codes["internal"] + spoilt.codes["internal"]
    figures = {
        "minutes": minutes,
        "frames": sum(found["frames"].values()),
        "lost": sum(found["frames"].values()) - sum(folded.values()),
        "stream_trouble": trouble,
        "starts": found["starts"],
        "predictions": answers.codes[""],
        "warming_up": answers.codes["warming_up"],
        "overloaded": answers.codes["overloaded"],
        "refused": refused,
        "unanswered": answers.unanswered + spoilt.unanswered,
        "internal_errors": internal,
        "predict_p50_ms": round(float(np.percentile(times, 50)), 2),
        "predict_p99_ms": round(float(np.percentile(times, 99)), 2),
        "spoilt": found["spoilt"],
        "rejected": int(samples[-1].rejected),
        "tasks": found["commands"]["begun"],
        "commands": found["commands"]["commands"],
        "resident_mb": round(samples[-1].resident / 1e6, 1),
        "growth_kb_per_min": round(slope / 1e3, 1),
        "exit_code": exit_code,
    }
    complaints = {
        "frames were lost": figures["lost"],
        "the service lost messages by a fault of its own": samples[-1].lost,
        "streams that were whole had gaps or the like": trouble,
        "good questions were refused": sum(refused.values()),
        "too many questions waited": answers.codes["overloaded"] > MOST_OVERLOAD * answers.asked,
        "questions were never answered": figures["unanswered"],
        "there were internal errors": internal,
        "no prediction came": not figures["predictions"],
        "no command came": not figures["commands"],
        "memory grows": minutes >= LEAST_MINUTES and slope * minutes / 2 > MOST_GAINED,
        "the service did not end cleanly": exit_code,
    }
    return Verdict(figures, [text for text, bad in complaints.items() if bad])
