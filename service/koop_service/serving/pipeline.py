"""The one thread that owns every trajectory: measurements in batches, answers between them.

No lock guards an estimator, because nobody else touches one. Each turn of the loop first serves
the measurements that a question waits for, then answers, then takes one batch of the oldest
measurements: questions wait for one batch at most, and cannot starve the measurements either.
Commands wait for nobody: they go out as soon as the frames of their batch are folded. What the logs
of sources send goes before live measurements: these are of use only after it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from koop_service.serving.admission.arrivals import Arrival
from koop_service.serving.admission.intake import Intake
from koop_service.serving.answering.desk import Desk
from koop_service.serving.answering.questions import Question
from koop_service.serving.durability.eviction import Eviction
from koop_service.serving.durability.snapshotter import Snapshotter
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.measurements import Measurements
from koop_service.serving.monitoring.vitals import Vitals
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.steering.commander import Commander

log = logging.getLogger("koop.pipeline")

_ANSWERING = 0.01
"""Longest time spent on answers between two batches [s]."""
_BRIEFLY = 0.002
"""The same while measurements come faster than they are folded [s]."""
_FINISHING = 0.5
"""Longest time spent on what still waits when the service stops [s]."""
_IDLE = 1.0
"""Longest sleep [s]."""
_WAITING = 0.01
"""The same while a question waits for a trajectory to catch up [s]."""
_AFTER_FAILURE = 0.01
"""Pause after a turn that failed [s]: the next one may fail too."""


class Pipeline:
    """Runs the loop in a thread of its own until it is stopped."""

    def __init__(
        self,
        intake: Intake[Question],
        measurements: Measurements,
        desk: Desk,
        commander: Commander,
        vitals: Vitals,
        recovery: Recovery,
        snapshotter: Snapshotter,
        eviction: Eviction,
        batch: int,
        lost: Callable[[int], None],
    ) -> None:
        self._intake = intake
        self._measurements = measurements
        self._desk = desk
        self._commander = commander
        self._vitals = vitals
        self._recovery = recovery
        self._snapshotter = snapshotter
        self._eviction = eviction
        self._batch = batch
        self._lost = lost
        self._brake = Brake()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="koop-pipeline", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self, timeout: float) -> None:
        """End after the batch in work, waiting `timeout` [s] at most for it."""
        self._stopping.set()
        self._intake.close()
        self._thread.join(timeout)

    @property
    def finished(self) -> bool:
        """Whether nobody touches the trajectories any more."""
        return not self._thread.is_alive()

    def step(self) -> None:
        """One turn of the loop."""
        self._vitals.turn()
        self._desk.collect()
        # After the questions: whoever asks for a task has declared its token before.
        self._commander.attend(self._intake.take_presences())
        self._recovery.attend(self._intake.take_news())
        self._process(self._urgent())
        self._desk.answer(_BRIEFLY if self._vitals.overloaded else _ANSWERING)
        self._replay()
        self._take_turns()
        self._snapshotter.step()
        self._eviction.step()

    def _process(self, arrivals: list[Arrival]) -> None:
        if arrivals:
            self._commander.command(self._measurements.process(arrivals))
            self._vitals.folded()

    def _take_turns(self) -> None:
        batch = self._intake.take(self._batch)
        if batch:
            start = time.monotonic()
            self._process(batch)
            self._intake.worked(batch, time.monotonic() - start)

    def _replay(self) -> None:
        """Fold what logs have sent, a batch at most, and the live messages that waited for it."""
        replays, behind = self._recovery.take(self._batch), self._recovery.behind
        self._process([arrival for replay in replays for arrival in replay.arrivals])
        # Together: one alone takes twice as long as one more.
        self._process([arrival for replay in replays for arrival in self._recovery.finish(replay)])
        if behind and not self._recovery.behind:
            self._snapshotter.hasten()

    def _urgent(self) -> list[Arrival]:
        """What questions wait for, a batch at most."""
        urgent: list[Arrival] = []
        for lane, ticket in self._desk.urgent():
            room = self._batch - len(urgent)
            if room == 0:
                break
            urgent += self._intake.take_of(lane, ticket, room)
        return urgent

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                if not (self._desk.busy or self._recovery.is_busy):
                    self._intake.wait(self._patience())
                self.step()
            except Exception:
                if self._brake.admit("turn") is not None:
                    log.exception("a turn of the pipeline failed; the service goes on")
                self._stopping.wait(_AFTER_FAILURE)
        self._finish()

    def _patience(self) -> float:
        """How long to sleep if nothing comes [s]."""
        waiting = _WAITING if self._desk.waits else _IDLE
        return min(waiting, self._recovery.pause(), self._snapshotter.pause())

    def _finish(self) -> None:
        """Fold what still waits, as far as time allows, and answer everybody."""
        deadline = time.monotonic() + _FINISHING
        while self._intake.depth and time.monotonic() < deadline:
            self.step()
        self._desk.abandon()
        self._commander.stop()
        if self._intake.depth:
            self._lost(self._intake.depth)
            log.warning("%d measurements still waited at the end", self._intake.depth)
