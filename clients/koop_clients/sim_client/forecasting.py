"""Asking the service for predictions, through its warm-up and its absences."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from koop_clients.queries import KoopClient, KoopError
from koop_clients.sim_client.patience import Patience, explained, in_few_words
from koop_protocol import ErrorCode, PredictReply


class Asker:
    """Puts questions to the service and keeps account of how it answered.

    Attributes:
        standing: in a few words, such as "warming up, 12 of 36 frames"; "" once it answers.
        latencies: the last answers' round trips [s].
        refused: questions that got no answer.
    """

    def __init__(self, client: KoopClient) -> None:
        self._client = client
        self._patience = Patience()
        self.standing = "waiting for the first answer"
        self.latencies: deque[float] = deque(maxlen=10_000)
        self.refused = 0
        self._last: KoopError | None = None

    @property
    def silence(self) -> str:
        """Why no question was ever answered; "" where one was, or the model was not ready yet."""
        if self.latencies or self._last is None or self._last.code == ErrorCode.warming_up:
            return ""
        return explained(self._last)

    def predict(
        self, trajectory: str, controls: np.ndarray | None, ahead: int
    ) -> PredictReply | None:
        """The predicted frames, or None while the service cannot tell.

        Raises KoopError for a refusal that waiting does not heal.
        """
        started = time.perf_counter()
        try:
            reply = self._client.predict(trajectory, ahead, controls, {"frames"})
        except KoopError as error:
            self._on_refusal(error)
            return None
        self.latencies.append(time.perf_counter() - started)
        self.standing = ""
        self._patience.restore()
        return reply

    def _on_refusal(self, error: KoopError) -> None:
        self._patience.try_with(error)
        self.refused += error.code not in (ErrorCode.warming_up, ErrorCode.unknown_trajectory)
        self.standing = in_few_words(error)
        self._last = error
