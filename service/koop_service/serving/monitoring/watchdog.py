"""Notices a pipeline that moves nothing any more: a lock, a disk or a library that never returns, a
device that cannot encode.

It says where every thread stands, and by default ends the process, so that its supervisor starts a
new one: a service that is stuck answers nobody and holds all its sources back, while a new one
continues from the last snapshots.

What keeps Python itself from running (native code that never gives the interpreter's lock back)
stops the watchdog too. For that there is a timer in faulthandler's own thread, which the watchdog
winds up again and again; it can only write and exit.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import tempfile
import threading
from collections.abc import Callable

log = logging.getLogger("koop.watchdog")

EXIT_CODE = 70
"""Of a process that ended itself since its pipeline was stuck; "internal software error"."""
_TICKS = 10
"""Looks in the time that a pipeline has."""


class Watchdog:
    """Looks ten times in `patience` [s] whether `turns` has changed; once a standstill calls
    `stuck` with what every thread does.

    It counts its looks, not the time: where the whole process stood still, nobody is to blame.
    """

    def __init__(
        self, turns: Callable[[], int], patience: float, stuck: Callable[[str], None], exits: bool
    ) -> None:
        self._turns = turns
        self._patience = patience
        self._stuck = stuck
        self._exits = exits
        self._seen = turns()
        self._idle = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="koop-watchdog", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._wind_up()
        self._thread.start()

    def stop(self) -> None:
        """Look no more."""
        self._stopping.set()
        self._thread.join()

    def look(self) -> None:
        """One look."""
        turns = self._turns()
        if turns != self._seen:
            if self._idle >= _TICKS:
                log.warning("the pipeline turns again")
            self._seen, self._idle = turns, 0
            return
        self._idle += 1
        if self._idle == _TICKS:
            self._stuck(stacks())

    def _run(self) -> None:
        while not self._stopping.wait(self._patience / _TICKS):
            self._wind_up()
            self.look()
        faulthandler.cancel_dump_traceback_later()

    def _wind_up(self) -> None:
        faulthandler.dump_traceback_later(2 * self._patience, exit=self._exits)


def stacks() -> str:
    """Where every thread of this process stands."""
    with tempfile.TemporaryFile("w+") as file:  # faulthandler needs a real one
        faulthandler.dump_traceback(file, all_threads=True)
        file.seek(0)
        return file.read()


def give_up(
    exits: bool, patience: float, count: Callable[[], None], encoder_fails: Callable[[], bool]
) -> Callable[[str], None]:
    """What happens to a stuck pipeline: it is counted, told, and the process ends if it `exits`."""

    def stuck(text: str) -> None:
        count()
        log.critical(
            "%s for %g s; %s. Its threads:\n%s",
            "nothing could be encoded" if encoder_fails() else "the pipeline has not turned",
            patience,
            "the process ends" if exits else "nobody is answered",
            text,
        )
        if exits:
            logging.shutdown()
            os._exit(EXIT_CODE)  # a clean end would wait for the pipeline

    return stuck
