"""The live loop of the cylinder: put a frame, say how the cylinder turns, and let the flow go on.

A frame takes tens of milliseconds of one core; it is computed when the next one is due. What was
commanded meanwhile is known by then, with the time at which it came.
"""

from __future__ import annotations

import time
from collections import deque

import zenoh

from koop_clients.flow.cylinder import RENDERER, CylinderFlow
from koop_clients.flow.forcing import law
from koop_clients.flow.plant import FlowPlant, starting
from koop_clients.flow.settings import FlowSettings
from koop_clients.queries import KoopClient
from koop_clients.replay.log import SourceLog
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.display import Display, usual
from koop_clients.sim_client.flowing.forecasts import FlowForecasts
from koop_clients.sim_client.flowing.phase import FlowDriving
from koop_clients.sim_client.flowing.record import FlowRecord
from koop_clients.sim_client.flowing.result import FlowResult, driven
from koop_clients.sim_client.flowing.stream import FlowStream
from koop_clients.sim_client.pacing import Pace, Stop
from koop_clients.sim_client.report import latency
from koop_clients.sources import FrameSource

_HEADING = f"{'time':>8} {'frames':>7} {'rotation':>13} {'v behind it':>13}   a frame takes"
_SPINNING_UP = f"{'':8} the flow develops, which is kept for the next time"
_KEPT = 10_000  # of the newest frames, the time each took


class FlowRun:
    """One run of the client over an open session."""

    def __init__(
        self,
        arguments: Arguments,
        settings: FlowSettings,
        session: zenoh.Session,
        display: Display,
        log: SourceLog | None = None,
    ) -> None:
        self._arguments = arguments
        self._display = display
        self._flow = CylinderFlow(settings)
        self._forecasts = FlowForecasts(arguments, KoopClient(session))
        self._driving = FlowDriving(arguments, self._flow, session, self._spun_up)
        self._streams = [self._stream(session, log, i) for i in range(arguments.trajectories)]
        self._took: deque[float] = deque(maxlen=_KEPT)
        self._swings: deque[float] = deque(maxlen=20)
        self._frames, self._elapsed, self._completed = 0, 0.0, False

    def run(self, stop: Stop) -> None:
        """Stream until the duration is over or `stop` says so.

        Raises DivergedError, and KoopError where the service cannot serve this stream.
        """
        started = time.monotonic()
        try:
            self._rounds(stop)
        finally:
            self._elapsed = time.monotonic() - started
            self._driving.close()
            self._display.close()
        self._completed = not stop

    @property
    def silence(self) -> str:
        """Why no prediction was ever answered; "" where one was, or none could be."""
        return self._forecasts.asker.silence

    def result(self) -> FlowResult:
        """What was found so far."""
        early, late = self._forecasts.errors()
        return FlowResult(
            system=self._arguments.system,
            drive=self._arguments.drive,
            trajectories=len(self._streams),
            frames=self._frames,
            simulated=self._streams[0].plant.number * self._arguments.interval,
            elapsed=self._elapsed,
            frame=latency(self._took),
            early=early,
            late=late,
            predict=latency(self._forecasts.asker.latencies),
            swing=max(self._swings, default=0.0),
            drives=[driven(drive) for drive in self._driving.drives],
            completed=self._completed,
        )

    def record(self) -> FlowRecord:
        """What pictures of the first flow's drive are drawn from."""
        return self._driving.record()

    def _stream(self, session: zenoh.Session, log: SourceLog | None, index: int) -> FlowStream:
        arguments = self._arguments
        seed = (arguments.seed, arguments.first + index)
        plant = FlowPlant(
            self._flow,
            law("schedule" if arguments.is_actuated else "rest", seed),
            starting(self._flow, seed, self._spun_up),
        )
        size = int(arguments.is_actuated)
        source = FrameSource(session, arguments.trajectory(index), size, RENDERER, log)
        return FlowStream(plant, source, self._driving.add(plant, source))

    def _spun_up(self, done: int, total: int) -> None:
        if self._display.due(_SPINNING_UP):
            self._display.row(_SPINNING_UP, f"{100 * done // total:6d} %")

    def _rounds(self, stop: Stop) -> None:
        """Each flow in turn, spread over a frame interval, frame by frame."""
        arguments, count, number = self._arguments, len(self._streams), 0
        pace = Pace(arguments.speed, stop)
        going = list(enumerate(self._streams))
        while number < arguments.frames and going and not stop:
            for index, stream in going:
                pace.wait((number + index / count) * arguments.interval)
                self._turn(stream, number)
            self._tell(number)
            going = [(index, stream) for index, stream in going if not stream.is_over]
            number += 1

    def _turn(self, stream: FlowStream, number: int) -> None:
        """A flow comes to frame `number`."""
        if number:
            started = time.perf_counter()
            stream.advance()
            self._took.append(time.perf_counter() - started)
        picture = stream.show()
        self._frames += 1
        if stream is self._streams[0]:
            self._forecasts.shown(stream, picture)

    def _tell(self, number: int) -> None:
        first = self._streams[0]
        probe = first.plant.probe
        self._swings.append(abs(probe))
        if self._display.due(_HEADING):
            time_shown = number * self._arguments.interval
            taken = "" if not self._took else f"{1000 * usual(self._took):.0f} ms"
            taken = self._driving.standing or self._forecasts.asker.standing or taken
            self._display.row(
                _HEADING,
                f"{time_shown:6.1f} s {self._frames:7d} {first.rotation:+9.3f} U/D "
                f"{probe:+11.3f} U   {taken}",
            )
