"""A worker as a process of this machine, started from the same Python."""

from __future__ import annotations

import contextlib
import os
import queue
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from koop_service.serving.placement.member import read_report


class Process:
    """`koop-serve --config FILE`; what it reports goes into `events`, at last its exit code.

    It has a session of its own, so that Ctrl-C reaches the supervisor alone; it stops by itself
    when this process is gone.
    """

    def __init__(self, config: Path, events: queue.SimpleQueue[Any]) -> None:
        self._events = events
        command = [sys.executable, "-m", "koop_service.cli", "--config", str(config)]
        places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}  # this very koop
        pipe = subprocess.PIPE
        self._child = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, text=True, start_new_session=True, env=places
        )
        threading.Thread(target=self._follow, name="koop-worker", daemon=True).start()

    @property
    def pid(self) -> int:
        """Its number."""
        return self._child.pid

    def tell(self, line: str) -> None:
        """Send it a line; one that has just died does not get it."""
        assert self._child.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._child.stdin.write(line + "\n")
            self._child.stdin.flush()

    def stop(self) -> None:
        """Ask it to stop."""
        self._child.terminate()

    def end(self, timeout: float) -> int:
        """Its exit code; killed when it takes longer than `timeout` [s]."""
        try:
            return self._child.wait(timeout)
        except subprocess.TimeoutExpired:
            self._child.kill()
            return self._child.wait()

    def _follow(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            self._events.put((self, read_report(line)))
        self._events.put((self, {"event": "exit", "code": self._child.wait()}))
