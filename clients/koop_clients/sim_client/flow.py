"""The live loop of the cylinder: put a frame, say how the cylinder turns, and let the flow go on.

A frame takes tens of milliseconds of one core; it is computed when it is due.
"""

from __future__ import annotations

import json
import time
from collections import deque
from dataclasses import asdict, dataclass

import zenoh

from koop_clients.flow.cylinder import RENDERER, CylinderFlow
from koop_clients.flow.forcing import law
from koop_clients.flow.plant import FlowPlant, starting
from koop_clients.flow.settings import FlowSettings
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.display import Display, usual
from koop_clients.sim_client.pacing import Pace, Stop
from koop_clients.sim_client.report import Latency, latency
from koop_clients.sources import FrameSource

_HEADING = f"{'time':>8} {'frames':>7} {'rotation':>13} {'v behind it':>13}   a frame takes"
_SPINNING_UP = f"{'':8} the wake develops, which is kept for the next time"
_KEPT = 10_000  # of the newest frames, the time each took


@dataclass(frozen=True)
class FlowResult:
    """What was streamed.

    Attributes:
        system: its name.
        trajectories: flows streamed at once.
        frames: frames put, over all flows.
        simulated: time simulated [s], 0.15 s a frame.
        elapsed: time on the wall [s].
        frame: what a frame took to simulate [s].
        swing: largest |v| behind the cylinder in the last 20 frames of the first flow [U].
        completed: False where it was stopped before its time.
    """

    system: str
    trajectories: int
    frames: int
    simulated: float
    elapsed: float
    frame: Latency | None
    swing: float
    completed: bool

    @property
    def frames_per_s(self) -> float:
        """Frames put for each second on the wall."""
        return self.frames / self.elapsed if self.elapsed else 0.0

    def to_json(self) -> str:
        """One line; seconds and U."""
        return json.dumps({**asdict(self), "frames_per_s": self.frames_per_s})

    def to_text(self) -> str:
        """For a reader."""
        flows = f" of {self.trajectories} flows" if self.trajectories > 1 else ""
        text = (
            f"streamed {self.frames} frames{flows} in {self.elapsed:.1f} s "
            f"({self.frames_per_s:.1f} frames/s), {self.simulated:.1f} s simulated\n"
            f"behind the cylinder the flow swings by {self.swing:.3f} U"
        )
        if self.frame is None:
            return text
        p50, p99 = 1000 * self.frame.p50, 1000 * self.frame.p99
        return text + f"\na frame took {p50:.1f} ms to simulate (p50), {p99:.1f} ms (p99)"


@dataclass(eq=False)
class FlowStream:
    """One flow and its source."""

    plant: FlowPlant
    source: FrameSource
    rotation: float = 0.0

    def show(self) -> None:
        """Put the present frame."""
        self.source.put_frame(self.plant.draw())

    def advance(self) -> None:
        """Go to the next frame; the rotation that leads to it is put."""
        self.rotation = self.plant.advance()
        if self.source.control_size:
            self.source.put_control([self.rotation])


class FlowRun:
    """One run of the client over an open session."""

    def __init__(
        self, arguments: Arguments, settings: FlowSettings, session: zenoh.Session, display: Display
    ) -> None:
        self._arguments = arguments
        self._display = display
        self._flow = CylinderFlow(settings)
        self._streams = [self._stream(session, i) for i in range(arguments.trajectories)]
        self._took: deque[float] = deque(maxlen=_KEPT)
        self._swings: deque[float] = deque(maxlen=20)
        self._frames, self._elapsed, self._completed = 0, 0.0, False

    def run(self, stop: Stop) -> None:
        """Stream until the duration is over or `stop` says so. Raises DivergedError."""
        started = time.monotonic()
        try:
            self._rounds(stop)
        finally:
            self._elapsed = time.monotonic() - started
            self._display.close()
        self._completed = not stop

    def result(self) -> FlowResult:
        """What was streamed so far."""
        return FlowResult(
            system=self._arguments.system,
            trajectories=len(self._streams),
            frames=self._frames,
            simulated=self._streams[0].plant.number * self._arguments.interval,
            elapsed=self._elapsed,
            frame=latency(self._took),
            swing=max(self._swings, default=0.0),
            completed=self._completed,
        )

    def _stream(self, session: zenoh.Session, index: int) -> FlowStream:
        arguments = self._arguments
        seed = (arguments.seed, arguments.first + index)
        plant = FlowPlant(
            self._flow,
            law("schedule" if arguments.is_actuated else "rest", seed),
            starting(self._flow, seed, self._spun_up),
        )
        size = int(arguments.is_actuated)
        return FlowStream(plant, FrameSource(session, arguments.trajectory(index), size, RENDERER))

    def _spun_up(self, done: int, total: int) -> None:
        if self._display.due(_SPINNING_UP):
            self._display.row(_SPINNING_UP, f"{100 * done // total:6d} %")

    def _rounds(self, stop: Stop) -> None:
        """Each flow in turn, spread over a frame interval, frame by frame."""
        arguments, count, number = self._arguments, len(self._streams), 0
        pace = Pace(arguments.speed, stop)
        while number < arguments.frames and not stop:
            for index, stream in enumerate(self._streams):
                pace.wait((number + index / count) * arguments.interval)
                self._turn(stream, number)
            self._tell(number)
            number += 1

    def _turn(self, stream: FlowStream, number: int) -> None:
        """A flow comes to frame `number`."""
        if number:
            started = time.perf_counter()
            stream.advance()
            self._took.append(time.perf_counter() - started)
        stream.show()
        self._frames += 1

    def _tell(self, number: int) -> None:
        first = self._streams[0]
        probe = first.plant.probe
        self._swings.append(abs(probe))
        if self._display.due(_HEADING):
            time_shown = number * self._arguments.interval
            taken = "" if not self._took else f"{1000 * usual(self._took):.0f} ms"
            self._display.row(
                _HEADING,
                f"{time_shown:6.1f} s {self._frames:7d} {first.rotation:+9.3f} U/D "
                f"{probe:+11.3f} U   {taken}",
            )
