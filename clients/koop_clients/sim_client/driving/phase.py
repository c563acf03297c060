"""The drives of all plants of a run: who drives them, how far they are, and what became of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import zenoh

from koop_clients.control import Controller
from koop_clients.mechanics.simulation import angle_between
from koop_clients.queries import KoopClient
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.display import DRIVING_HEADING, Display, driving_row, usual
from koop_clients.sim_client.driving.baselines import pd_law, state_lqr_law
from koop_clients.sim_client.driving.commanded import Commanded
from koop_clients.sim_client.driving.drive import Course, Drive
from koop_clients.sim_client.driving.driver import Driver, Knowing
from koop_clients.sim_client.driving.outcome import NEAR
from koop_clients.sim_client.driving.planned import Planned
from koop_clients.sim_client.driving.registration import Registration
from koop_clients.sim_client.driving.target import Target
from koop_clients.sim_client.driving.timing import Timing
from koop_clients.sim_client.options import DriveOptions
from koop_clients.sim_client.streaming import Stream
from koop_protocol import LqrQuery

_ASKING = 8  # questions at a time
_TROUBLE = 1  # of a plant's random numbers


class Driving:
    """The phase in which plants are driven; each begins it by itself.

    Attributes:
        drives: one for each stream, in order; empty where none is to be driven.
    """

    def __init__(
        self,
        arguments: Arguments,
        target: Target,
        streams: Sequence[Stream],
        session: zenoh.Session,
        lag: Callable[[], float],
        display: Display,
    ) -> None:
        self._target = target
        self._display = display
        self._told: set[int] = set()
        self._asking = ThreadPoolExecutor(_ASKING, "koop-begin")
        self.drives: list[Drive] = []
        if not arguments.drives:
            return
        make = _driver_maker(arguments, target, session, self._asking, lag)
        for index, stream in enumerate(streams):
            course = _course(arguments, target, index)
            self.drives.append(Drive(stream, make(stream), course, keep_frames=index == 0))

    def shown(self, index: int, frame: np.ndarray) -> None:
        """Plant `index` has put a frame."""
        self.drives[index].shown(frame)

    def advance(self, index: int) -> None:
        """Plant `index` goes on to its next frame."""
        drive = self.drives[index]
        drive.advance()
        if drive.is_over:
            drive.driver.close()
        if drive.driver.account.reasons and index not in self._told:
            self._told.add(index)
            why = "; ".join(drive.driver.account.reasons)
            self._display.say(f"{drive.trajectory} is not fit for control yet: {why}")

    def tell(self, number: int) -> None:
        """A progress row about the first plant, if it is time for one."""
        if self.drives[0].log.angles and self._display.due(DRIVING_HEADING):
            self._display.row(DRIVING_HEADING, self._row(number))

    def planned_pictures(self) -> np.ndarray | None:
        """(N, H, W) what the first plant's plan leads to; None where it follows none blindly."""
        driver = self.drives[0].driver if self.drives else None
        return driver.pictures if isinstance(driver, Planned) else None

    def close(self) -> None:
        """End what has not ended yet."""
        self._asking.shutdown(cancel_futures=True)
        for drive in self.drives:
            if not drive.is_over:
                drive.driver.close()

    def _row(self, number: int) -> str:
        first = self.drives[0]
        angle = first.log.angles[-1]
        standing = first.driver.standing
        if len(self.drives) > 1:
            near = sum(self._is_near(drive) for drive in self.drives)
            standing = f"{near} of {len(self.drives)} at the target"
        return driving_row(
            number,
            float(angle_between(angle, 0.0)),
            float(angle_between(angle, self._target.angle)),
            first.log.torques[-1],
            standing,
            usual(first.driver.account.latencies),
        )

    def _is_near(self, drive: Drive) -> bool:
        angles = drive.log.angles
        return bool(angles) and abs(float(angle_between(angles[-1], self._target.angle))) <= NEAR


def lqr_query(
    options: DriveOptions, method: str, target_image: np.ndarray, largest: float
) -> LqrQuery:
    """What the service is asked to do: bring the plant to the target with controls up to
    `largest`."""
    bound = np.array([largest])
    terminal = None if options.qf == "none" else options.qf
    return LqrQuery(
        options.horizon,
        target_image=target_image,
        q=options.q,
        r=options.r,
        qf=terminal if terminal in (None, "riccati") else float(terminal),
        u_min=-bound,
        u_max=bound,
        method=method,
        force=options.force,
    )


def _course(arguments: Arguments, target: Target, index: int) -> Course:
    # A plan's drive ends with the frame that its last torque leads to.
    blind = arguments.drive == "plan"
    return Course(
        takeover=int(arguments.takeover),
        frames=arguments.driving.horizon + 1 if blind else arguments.frames - arguments.takeover,
        target=target.angle,
        trouble=arguments.trouble,
        seed=(arguments.seed, arguments.first + index, _TROUBLE),
    )


def _driver_maker(
    arguments: Arguments,
    target: Target,
    session: zenoh.Session,
    asking: Executor,
    lag: Callable[[], float],
) -> Callable[[Stream], Driver]:
    options, bound = arguments.driving, arguments.driving.torque_bound
    if arguments.method is None:
        if arguments.drive == "pd":
            return lambda stream: Knowing(pd_law(stream.plant.system, target.angle, bound))
        return lambda stream: Knowing(
            state_lqr_law(stream.plant.system, target.angle, options.r, bound)
        )
    query = lqr_query(options, arguments.method, target.picture, bound)
    timing = Timing(arguments.speed, arguments.trouble.delay)

    def planned(stream: Stream) -> Driver:
        source, client = stream.source, KoopClient(session)
        asked = replace(query, returns=frozenset({"frames"}))
        return Planned(
            lambda: client.lqr(source.trajectory, asked),
            Registration(asking, source.trajectory, source.epoch),
            int(arguments.takeover),
        )

    def commanded(stream: Stream) -> Driver:
        source = stream.source
        return Commanded(
            lambda asked: Controller(session, source.trajectory, asked, frozen=options.frozen),
            query,
            Registration(asking, source.trajectory, source.epoch),
            timing,
            int(arguments.takeover),
            lag,
        )

    return planned if arguments.drive == "plan" else commanded
