"""Obeying the service: at each frame the torque that `koop/lqr` plans for it."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import FRAME_INTERVAL, hold, with_pole
from koop_clients.mechanics.systems import System
from koop_clients.queries import KoopClient, KoopError
from koop_clients.sim_client.arguments import Arguments, DriveOptions
from koop_clients.sim_client.display import DRIVING_HEADING, Display, driving_row, usual
from koop_clients.sim_client.outcome import angle_between
from koop_clients.sim_client.patience import Patience, in_few_words
from koop_clients.sim_client.record import DriveLog
from koop_clients.sim_client.streaming import Stream
from koop_protocol import LqrQuery, LqrReply

_PATIENCE = 1.0  # s to wait for a plan where simulated time may wait


class Planner:
    """Asks for a plan at each frame; where none comes in time, the last one is followed on.

    Attributes:
        latencies: the answers' round trips [s].
        late: frames without a plan of their own.
        standing: why the last frame had none, or what is wrong with its plan; else "".
    """

    def __init__(
        self, client: KoopClient, trajectory: str, query: LqrQuery, deadline: float
    ) -> None:
        self._client = client
        self._trajectory = trajectory
        self._query = query
        self._deadline = deadline
        self._plan: LqrReply | None = None
        self._patience = Patience()
        self.latencies: deque[float] = deque(maxlen=10_000)
        self.late = 0
        self.standing = ""

    def torque(self, seq: int) -> float:
        """The torque [N m] to hold between frame `seq`, put just now, and the next.

        Raises KoopError for a refusal that waiting does not heal.
        """
        started = time.perf_counter()
        try:
            self._plan = self._client.lqr(self._trajectory, self._query, timeout=self._deadline)
        except KoopError as error:
            self._patience.try_with(error)
            self.late += 1
            self.standing = in_few_words(error)
        else:
            self._patience.restore()
            self.latencies.append(time.perf_counter() - started)
            self.standing = "" if self._plan.status == "solved" else self._plan.status
        return planned_torque(self._plan, seq)


def planned_torque(plan: LqrReply | None, seq: int) -> float:
    """What `plan` says [N m] for the interval after frame `seq`; 0 where it says nothing."""
    if plan is None or not 0 <= seq - plan.seq < len(plan.controls):
        return 0.0
    return float(plan.controls[seq - plan.seq, 0])


def lqr_query(system: System, options: DriveOptions) -> LqrQuery:
    """The question to ask at each frame: to the picture of the target."""
    bound = np.array([options.torque_bound])
    picture = Renderer(system)(with_pole(system, options.target_angle).q)
    return LqrQuery(
        options.horizon,
        target_image=picture,
        q=options.q,
        r=options.r,
        u_min=-bound,
        u_max=bound,
    )


class Driving:
    """The phase in which the service's torques act on the plant."""

    def __init__(
        self, arguments: Arguments, stream: Stream, client: KoopClient, display: Display
    ) -> None:
        self._options = arguments.lqr
        self._stream = stream
        self._display = display
        query = lqr_query(stream.plant.system, arguments.lqr)
        # A plan must come before the next frame; at other speeds simulated time waits for it.
        deadline = 0.9 * FRAME_INTERVAL if arguments.speed == 1.0 else _PATIENCE
        self.planner = Planner(client, stream.source.trajectory, query, deadline)
        self.log = DriveLog()

    def prepare(self, number: int) -> None:
        """Ask before taking over: that plan reaches into the drive, should the next be late."""
        self.planner.torque(number)

    def step(self, number: int, frame: np.ndarray) -> None:
        """Frame `number` was put: let the planned torque act until the next."""
        plant, bound = self._stream.plant, self._options.torque_bound
        torque = float(np.clip(self.planner.torque(number), -bound, bound))
        plant.obey(hold(torque))
        angle = float(plant.state.q[plant.system.pole])
        self._stream.advance()
        self.log.add(frame, angle, torque)
        if self._display.due(DRIVING_HEADING):
            self._tell(number, angle, torque)

    def _tell(self, number: int, angle: float, torque: float) -> None:
        row = driving_row(
            number,
            float(angle_between(angle, 0.0)),
            float(angle_between(angle, self._options.target_angle)),
            torque,
            self.planner.standing,
            usual(self.planner.latencies),
        )
        self._display.row(DRIVING_HEADING, row)
