"""Predictions asked for while a flow is streamed, and judged by what came."""

from __future__ import annotations

import numpy as np

from koop_clients.queries import KoopClient
from koop_clients.sim_client.arguments import Arguments
from koop_clients.sim_client.driving.registration import another_source
from koop_clients.sim_client.flowing.stream import FlowStream
from koop_clients.sim_client.forecasting import Asker
from koop_clients.sim_client.record import Scorebook
from koop_clients.sim_client.scoring import Errors, Forecast, Judge, pool


class FlowForecasts:
    """Of the first flow, while a schedule turns its cylinder or nothing does.

    Attributes:
        asker: puts the questions.
        book: what was judged.
    """

    def __init__(self, arguments: Arguments, client: KoopClient) -> None:
        self.asker = Asker(client)
        self.book = Scorebook()
        self._horizons = arguments.horizons
        self._ahead = arguments.prediction.ahead
        self._period = max(1, round(arguments.prediction.ask_every / arguments.interval))
        self._last = arguments.takeover  # from there on nobody knows the rotations to come
        self._judge = Judge()

    def shown(self, stream: FlowStream, picture: np.ndarray) -> None:
        """The stream has put a frame: judge what it completes, and ask if it is time to.

        Raises KoopError for a refusal that waiting does not heal.
        """
        number = stream.plant.number
        for judged in self._judge.see(number, picture):
            self.book.add(judged)
        if number % self._period == 0 and number + self._ahead <= self._last:
            self._ask(stream, picture)

    def errors(self) -> tuple[Errors | None, Errors | None]:
        """Of the first predictions and of the last ones."""
        return pool(self.book.first, self._horizons), pool(self.book.last, self._horizons)

    def _ask(self, stream: FlowStream, picture: np.ndarray) -> None:
        known = stream.source.control_size > 0
        rotations = stream.plant.look_ahead(self._ahead)[:, None] if known else None
        reply = self.asker.predict(stream.source.trajectory, rotations, self._ahead)
        if reply is None or reply.frames is None:
            return
        if reply.epoch != stream.source.epoch:
            raise another_source(stream.source.trajectory)
        if reply.seq == stream.plant.number:
            self._judge.predict(Forecast(reply.seq, picture, reply.frames))
