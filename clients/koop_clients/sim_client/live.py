"""The live loop: show a frame, ask or obey, let the control act, and tell how it goes."""

from __future__ import annotations

import math
import time

import numpy as np
import zenoh

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.mechanics.systems import System
from koop_clients.queries import KoopClient
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.display import Display
from koop_clients.sim_client.driving import Driving
from koop_clients.sim_client.forecasting import Asker
from koop_clients.sim_client.learning import Learning
from koop_clients.sim_client.outcome import outcome
from koop_clients.sim_client.pacing import Pace, Stop
from koop_clients.sim_client.record import Record, Scorebook
from koop_clients.sim_client.report import Result, latency
from koop_clients.sim_client.schedule import takeover_frame
from koop_clients.sim_client.scoring import pool
from koop_clients.sim_client.streaming import open_streams


class LiveRun:
    """One run of the client over an open session."""

    def __init__(
        self, arguments: Arguments, system: System, session: zenoh.Session, display: Display
    ) -> None:
        self._arguments = arguments
        self._display = display
        self._streams = open_streams(arguments, system, session)
        self._plant = self._streams[0].plant
        self._takeover = takeover_frame(arguments)
        client = KoopClient(session)
        self._asker = Asker(client)
        self._learning = Learning(arguments, self._streams, self._asker, display)
        self._driving = Driving(arguments, self._streams[0], client, display)
        self._book, self._others = Scorebook(), Scorebook()
        self._elapsed = 0.0
        self._completed = False

    def run(self, stop: Stop) -> None:
        """Stream until the duration is over or `stop` says so.

        Raises KoopError where the service cannot serve this stream.
        """
        frames = round(self._arguments.duration / FRAME_INTERVAL) or math.inf
        pace = Pace(self._arguments.speed, stop)
        started = time.monotonic()
        try:
            while not stop and self._plant.number < frames:
                pace.wait(self._plant.number * FRAME_INTERVAL)
                self._frame(self._plant.number)
        finally:
            self._elapsed = time.monotonic() - started
            self._display.close()
        self._completed = not stop

    def _frame(self, number: int) -> None:
        books = [self._book] + [self._others] * (len(self._streams) - 1)
        frames = [stream.show(book) for stream, book in zip(self._streams, books, strict=True)]
        if number == self._takeover - 1:
            self._driving.prepare(number)
        if number >= self._takeover:
            self._driving.step(number, frames[0])
        else:
            self._learning.step(number, frames, self._book)

    def result(self) -> Result:
        """What was found so far."""
        frames, horizons = self._plant.number, self._arguments.horizons
        planner, log = self._driving.planner, self._driving.log
        return Result(
            system=self._arguments.system,
            trajectories=len(self._streams),
            frames=frames * len(self._streams),
            simulated=frames * FRAME_INTERVAL,
            elapsed=self._elapsed,
            early=pool(self._book.first, horizons),
            late=pool(self._book.last, horizons),
            others=pool(self._others.recent(), horizons),
            predict=latency(self._asker.latencies),
            lqr=latency(planner.latencies),
            refused=self._asker.refused,
            late_plans=planner.late,
            drive=outcome(log.angles, log.torques, self._arguments.lqr.target_angle),
            completed=self._completed,
        )

    def record(self) -> Record:
        """What pictures are drawn from."""
        log, shape = self._driving.log, self._plant.draw().shape
        return Record(
            self._arguments.system,
            self._book.first,
            list(self._book.last),
            np.array(log.frames, np.uint8).reshape(-1, *shape),
            np.array(log.angles),
            np.array(log.torques),
            self._arguments.lqr.target_angle,
            self._arguments.lqr.torque_bound,
        )
