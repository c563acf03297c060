"""The live loop: show a frame, ask or obey, let the control act, and tell how it goes.

A plant's interval is simulated when its next frame is due. What was commanded meanwhile is known by
then, with the time at which it came; so nothing waits for the service, and twenty plants take turns
within one frame interval.
"""

from __future__ import annotations

import math
import time

import numpy as np
import zenoh

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.mechanics.systems import System
from koop_clients.queries import KoopClient
from koop_clients.replay.log import SourceLog
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.display import Display, usual
from koop_clients.sim_client.driving.phase import Driving
from koop_clients.sim_client.driving.target import Target
from koop_clients.sim_client.forecasting import Asker
from koop_clients.sim_client.learning import Learning
from koop_clients.sim_client.pacing import Pace, Stop
from koop_clients.sim_client.record import Record, Scorebook, stack_series
from koop_clients.sim_client.report import Result, driven, latency, totals
from koop_clients.sim_client.scoring import pool
from koop_clients.sim_client.streaming import open_streams


class LiveRun:
    """One run of the client over an open session."""

    def __init__(
        self,
        arguments: Arguments,
        system: System,
        target: Target,
        session: zenoh.Session,
        display: Display,
        log: SourceLog | None = None,
    ) -> None:
        self._arguments = arguments
        self._display = display
        self._target = target
        self._streams = open_streams(arguments, system, target.angle, session, log)
        self._asker = Asker(KoopClient(session))
        self._learning = Learning(arguments, self._streams, self._asker, display)
        self._driving = Driving(arguments, target, self._streams, session, self._lag, display)
        self._book, self._others = Scorebook(), Scorebook()
        self._elapsed = 0.0
        self._completed = False

    def run(self, stop: Stop) -> None:
        """Stream until the duration is over or `stop` says so.

        Raises KoopError where the service cannot serve this stream.
        """
        started = time.monotonic()
        try:
            self._rounds(stop)
        finally:
            self._elapsed = time.monotonic() - started
            self._driving.close()
            self._display.close()
        self._completed = not stop

    def _rounds(self, stop: Stop) -> None:
        """Each plant in turn, spread over a frame interval, frame by frame."""
        pace = Pace(self._arguments.speed, stop)
        count, number = len(self._streams), 0
        going = list(range(count))
        while going and not stop:
            for index in going:
                pace.wait((number + index / count) * FRAME_INTERVAL)
                self._turn(index, number)
            going = [index for index in going if not self._is_over(index)]
            number += 1

    def _turn(self, index: int, number: int) -> None:
        """Plant `index` comes to frame `number`."""
        if number:
            self._advance(index)
        if self._is_over(index):
            return
        frame = self._streams[index].show(self._others if index else self._book)
        if self._driving.drives:
            self._driving.shown(index, frame)
        self._learning.shown(index, number, frame)
        if index == 0:
            self._tell(number)

    def _advance(self, index: int) -> None:
        if self._driving.drives:
            self._driving.advance(index)
        else:
            self._streams[index].advance()

    def _is_over(self, index: int) -> bool:
        if self._driving.drives:
            return self._driving.drives[index].is_over
        return self._streams[index].plant.number >= self._arguments.frames

    def _tell(self, number: int) -> None:
        drives = self._driving.drives
        if drives and drives[0].began is not None:
            self._driving.tell(number)
        else:
            self._learning.tell(number, self._book)

    def _lag(self) -> float:
        """How long after a frame its prediction has come, lately [s]."""
        lag = usual(self._asker.latencies)
        return 0.0 if math.isnan(lag) else lag

    @property
    def silence(self) -> str:
        """Why no prediction was ever answered; "" where one was, or none could be."""
        return self._asker.silence

    def result(self) -> Result:
        """What was found so far."""
        horizons = self._arguments.horizons
        drives = [driven(drive) for drive in self._driving.drives]
        return Result(
            system=self._arguments.system,
            drive=self._arguments.drive,
            trajectories=len(self._streams),
            frames=sum(stream.frames for stream in self._streams),
            simulated=max(stream.plant.number for stream in self._streams) * FRAME_INTERVAL,
            elapsed=self._elapsed,
            early=pool(self._book.first, horizons),
            late=pool(self._book.last, horizons),
            others=pool(self._others.recent(), horizons),
            predict=latency(self._asker.latencies),
            refused=self._asker.refused,
            drives=drives,
            totals=totals(drives, [d.driver.account for d in self._driving.drives]),
            completed=self._completed,
        )

    def record(self) -> Record:
        """What pictures are drawn from."""
        series = [drive.log.series() for drive in self._driving.drives]
        shape = self._streams[0].plant.draw().shape
        frames = self._driving.drives[0].log.frames if series else []
        planned = self._driving.planned_pictures()
        return Record(
            self._arguments.system,
            self._book.first,
            list(self._book.last),
            np.array(frames, np.uint8).reshape(-1, *shape),
            stack_series(series),
            self._target.angle,
            self._arguments.driving.torque_bound,
            np.zeros((0, *shape), np.uint8) if planned is None else planned,
        )
