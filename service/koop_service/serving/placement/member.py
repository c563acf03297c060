"""A worker's end of its supervisor's pipes: what it is told, and what it tells.

It loads everything first and says so; then a line on standard input says which worker it is to be.
When standard input closes its supervisor is gone, and it stops.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import sys
import threading
from typing import Any

FENCED = 3
"""Exit code of a service whose shards somebody else has claimed."""


class Orders:
    """What comes in on standard input; `stop` is set when that closes."""

    def __init__(self, stop: threading.Event, descriptor: int = 0) -> None:
        self._stop = stop
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._descriptor = descriptor
        # A daemon, and without a file object's lock: nothing waits for it at the end.
        threading.Thread(target=self._read, name="koop-orders", daemon=True).start()

    def next(self) -> str | None:
        """The next line, waiting for it; None when it is time to stop."""
        while not self._stop.is_set():
            try:
                return self._lines.get(timeout=0.2)
            except queue.Empty:
                continue
        return None

    def _read(self) -> None:
        rest = b""
        while chunk := os.read(self._descriptor, 4096):
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._lines.put(line.decode().strip())
        self._stop.set()


def report(event: str, **figures: Any) -> None:
    """Tell the supervisor, as one JSON object on a line of standard output; if it is there."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps({"event": event, **figures}), flush=True)


def read_report(line: str) -> dict[str, Any]:
    """What `report` told; a line of anything else is passed on to standard output."""
    try:
        told = json.loads(line)
        if isinstance(told, dict) and "event" in told:
            return told
    except ValueError:
        pass
    sys.stdout.write(line)
    return {"event": ""}
