"""The drives of all flows of a run: who turns their cylinders, and towards what."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import zenoh

from koop_clients.control import Controller
from koop_clients.flow.cylinder import CylinderFlow, stream_momentum
from koop_clients.flow.forcing import feedback
from koop_clients.flow.plant import FlowPlant, natural_swing
from koop_clients.flow.settings import FRAME_INTERVAL
from koop_clients.flow.spinup import Progress, developed, steady
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.driving.phase import lqr_query
from koop_clients.sim_client.driving.registration import Registration
from koop_clients.sim_client.driving.timing import Timing
from koop_clients.sim_client.flowing.drive import MOMENTUM, FlowDrive
from koop_clients.sim_client.flowing.drivers import STEP, FlowDriver, Obeying, Reference
from koop_clients.sim_client.flowing.record import FlowRecord
from koop_clients.sim_client.record import stack_series
from koop_clients.sources import FrameSource

_ASKING = 4  # questions at a time


class FlowDriving:
    """The phase in which wakes are driven to the steady flow; each begins it by itself.

    Attributes:
        drives: one for each flow added, in order; empty where none is to be driven.
    """

    def __init__(
        self,
        arguments: Arguments,
        flow: CylinderFlow,
        session: zenoh.Session,
        progress: Progress,
    ) -> None:
        self.drives: list[FlowDrive] = []
        self._arguments = arguments
        self._session = session
        self._asking = ThreadPoolExecutor(_ASKING, "koop-begin")
        self._target = np.zeros(0)
        self._natural = 0.0
        if arguments.drives:
            self._target = flow.picture(steady(flow, progress))
            self._natural = natural_swing(flow, developed(flow, progress))

    @property
    def standing(self) -> str:
        """What is the matter with the first drive, in a few words; else ""."""
        return self.drives[0].driver.standing if self.drives else ""

    def add(self, plant: FlowPlant, source: FrameSource) -> FlowDrive | None:
        """The drive of one more flow, if flows are to be driven."""
        if not self._arguments.drives:
            return None
        drive = FlowDrive(
            plant,
            self._driver(source),
            self._arguments.takeover,
            self._natural,
            keep_pictures=not self.drives,
        )
        self.drives.append(drive)
        return drive

    def close(self) -> None:
        """End what has not ended yet."""
        self._asking.shutdown(cancel_futures=True)
        for drive in self.drives:
            drive.driver.close()

    def record(self) -> FlowRecord:
        """What the drives were."""
        logs = [drive.log for drive in self.drives]
        series = stack_series([log.series() for log in logs], columns=2)
        return FlowRecord(
            momenta=stream_momentum(logs[0].momenta(self._target)),
            target=stream_momentum(self._target[MOMENTUM]),
            probes=series[..., 0],
            rotations=series[..., 1],
            natural=self._natural,
        )

    def _driver(self, source: FrameSource) -> FlowDriver:
        arguments, bound = self._arguments, self._arguments.flow.rotation_bound
        options, method = arguments.driving, arguments.method
        if method is None:
            return Reference(feedback(bound=bound))
        return Obeying(
            lambda asked: Controller(
                self._session, source.trajectory, asked, frozen=options.frozen
            ),
            lqr_query(options, method, self._target, bound),
            Registration(self._asking, source.trajectory, source.epoch),
            Timing(arguments.speed, arguments.trouble.delay, FRAME_INTERVAL, STEP),
            int(arguments.takeover),
            lag=lambda: 0.0,
        )
