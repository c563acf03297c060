"""The phase in which the service watches: it is asked what comes next, and judged by what came."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.display import Display, learning_heading, learning_row, usual
from koop_clients.sim_client.driving.registration import another_source
from koop_clients.sim_client.forecasting import Asker
from koop_clients.sim_client.record import Scorebook
from koop_clients.sim_client.schedule import approach_frame
from koop_clients.sim_client.scoring import Forecast, pool
from koop_clients.sim_client.streaming import Stream
from koop_protocol import PredictReply

_RECENT = 20  # forecasts behind the errors of a progress row


class Learning:
    """Predictions of the first plant at each turn, and of one of the others in rotation."""

    def __init__(
        self, arguments: Arguments, streams: Sequence[Stream], asker: Asker, display: Display
    ) -> None:
        self._horizons = arguments.horizons
        self._ahead = arguments.prediction.ahead
        self._period = max(1, round(arguments.prediction.ask_every / FRAME_INTERVAL))
        self._last = approach_frame(arguments)
        self._streams = streams
        self._asker = asker
        self._display = display

    def shown(self, index: int, number: int, frame: np.ndarray) -> None:
        """Plant `index` has put frame `number`: ask about it, if it is its turn."""
        # While the pole is lifted the plant is elsewhere with every frame: that is not judged.
        if number % self._period or number + self._ahead > self._last:
            return
        others = len(self._streams) - 1
        if index == 0 or index == 1 + (number // self._period) % others:
            self._forecast(index, frame)

    def tell(self, number: int, book: Scorebook) -> None:
        """A progress row, if it is time for one."""
        heading = learning_heading(self._horizons)
        if self._display.due(heading):
            self._display.row(heading, self._row(number, book))

    def _forecast(self, index: int, frame: np.ndarray) -> None:
        """Ask about one plant, with the torques that it is really going to get."""
        stream = self._streams[index]
        controls = stream.plant.look_ahead(self._ahead) if stream.source.control_size else None
        reply = self._asker.predict(stream.source.trajectory, controls, self._ahead)
        if reply is None:
            return
        _check_epoch(reply, stream)
        if reply.seq == stream.plant.number and reply.frames is not None:
            stream.judge.predict(Forecast(reply.seq, frame, reply.frames))

    def _row(self, number: int, book: Scorebook) -> str:
        return learning_row(
            self._display,
            number,
            sum(stream.frames for stream in self._streams),
            pool(book.recent(_RECENT), self._horizons),
            self._asker.standing,
            usual(self._asker.latencies),
        )


def _check_epoch(reply: PredictReply, stream: Stream) -> None:
    if reply.epoch != stream.source.epoch:
        raise another_source(stream.source.trajectory)
