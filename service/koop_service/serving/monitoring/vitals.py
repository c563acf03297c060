"""What `koop/health` says of this worker."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from koop_protocol import OVERLOADED, SHORT_OF_MEMORY, Health
from koop_service.serving.admission.intake import Intake
from koop_service.serving.admission.strain import Strain
from koop_service.serving.monitoring.memory import Memory
from koop_service.serving.trajectories.registry import Registry


def worker_name() -> str:
    """This process, for people and for checks on the same host."""
    return f"{socket.gethostname()}:{os.getpid()}"


class Vitals:
    """Asked and told by the pipeline's own thread, so that an answer means that it moves."""

    def __init__(
        self,
        worker: str,
        intake: Intake[Any],
        registry: Registry,
        queue: Strain,
        memory: Memory,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._worker = worker
        self._intake = intake
        self._registry = registry
        self._queue = queue
        self._memory = memory
        self._clock = clock
        self._turns = 0
        self._began = clock()
        self._last_fold: float | None = None
        self._troubles: dict[str, Callable[[], bool]] = {}
        self.watch(OVERLOADED, lambda: queue.active)
        self.watch(SHORT_OF_MEMORY, lambda: memory.strain.active)

    @property
    def turns(self) -> int:
        """How often the pipeline has turned: every second at least, unless it is stuck."""
        return self._turns

    @property
    def overloaded(self) -> bool:
        """Whether measurements come faster than they are folded."""
        return self._queue.active

    def turn(self) -> None:
        """A turn begins: see how full everything is."""
        self._turns += 1
        self._queue.observe(self._intake.load)
        self._memory.observe()

    def watch(self, word: str, is_so: Callable[[], bool]) -> None:
        """Say `word` under `degraded` as long as it is so."""
        self._troubles[word] = is_so

    def folded(self) -> None:
        """Measurements were folded just now."""
        self._last_fold = self._clock()

    def report(self) -> Health:
        """How it stands."""
        now = self._clock()
        return Health(
            self._worker,
            _version(),
            now - self._began,
            len(self._registry),
            self._intake.depth,
            self._intake.unanswered,
            None if self._last_fold is None else now - self._last_fold,
            tuple(word for word, is_so in self._troubles.items() if is_so()),
        )


def _version() -> str:
    try:
        return version("koop")
    except PackageNotFoundError:  # run from its sources
        return "unknown"
