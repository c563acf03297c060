"""Structured logs on standard error, and a brake for what may happen at every frame."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Callable
from typing import Any

_PLAIN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}
_EVERY = 10.0
"""Seconds between two lines of one kind."""


def configure(format_: str, level: str, worker: str = "") -> None:
    """Send the log to standard error, as text or as one JSON object a line.

    `worker` stands in every line, where there are several (`1/3`).
    """
    handler = logging.StreamHandler(sys.stderr)
    formatter = JsonFormatter(worker) if format_ == "json" else TextFormatter(worker)
    handler.setFormatter(formatter)
    logger = logging.getLogger("koop")
    logger.handlers[:] = [handler]
    logger.setLevel(level.upper())
    logger.propagate = False


def fields_of(record: logging.LogRecord) -> dict[str, Any]:
    """What was passed as `extra`."""
    return {name: value for name, value in vars(record).items() if name not in _PLAIN}


class TextFormatter(logging.Formatter):
    """`12:00:01 info  text` for people; warnings and worse say so."""

    def __init__(self, worker: str = "") -> None:
        who = f"worker {worker}: " if worker else ""
        super().__init__(f"%(asctime)s %(levelname)-7s {who}%(message)s", "%H:%M:%S")


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time (UTC, ISO 8601), level, message, and the record's own fields."""

    def __init__(self, worker: str = "") -> None:
        super().__init__()
        self._who = {"worker": worker} if worker else {}

    def format(self, record: logging.LogRecord) -> str:
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        entry: dict[str, Any] = {
            "time": f"{seconds}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "message": record.getMessage(),
            **self._who,
            **fields_of(record),
        }
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


class Brake:
    """Lets the first event of a kind through, then one every ten seconds with a count.

    What a source does wrong it does at every frame; the log must stay readable and small.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, every: float = _EVERY) -> None:
        self._clock = clock
        self._every = every
        self._held: dict[str, tuple[float, int]] = {}

    def admit(self, kind: str) -> int | None:
        """None to stay quiet; else how many events of this kind were held back since the last."""
        now = self._clock()
        last, held = self._held.get(kind, (-self._every, 0))
        if now - last < self._every:
            self._held[kind] = (last, held + 1)
            return None
        self._held[kind] = (now, 0)
        return held
