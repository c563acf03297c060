"""One flow and its source, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from koop_clients.flow.plant import FlowPlant
from koop_clients.sim_client.flowing.drive import FlowDrive
from koop_clients.sources import FrameSource


@dataclass(eq=False)
class FlowStream:
    """A flow that is shown, and turned by a law or, once that has begun, by a drive.

    Attributes:
        plant: what flows.
        source: puts its frames.
        drive: None where nobody drives it.
        rotation: of the last interval [U/D].
    """

    plant: FlowPlant
    source: FrameSource
    drive: FlowDrive | None = None
    rotation: float = 0.0

    def show(self) -> np.ndarray:
        """Put the present frame."""
        picture = self.plant.draw()
        self.source.put_frame(picture)
        if self.drive is not None:
            self.drive.shown(picture)
        return picture

    def advance(self) -> None:
        """Go to the next frame; the rotation that leads to it is put."""
        self.rotation = self.plant.advance() if self.drive is None else self.drive.advance()
        if self.source.control_size:
            self.source.put_control([self.rotation])

    @property
    def is_over(self) -> bool:
        """Whether nobody will ever drive it who should."""
        return self.drive is not None and self.drive.has_given_up
