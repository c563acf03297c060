"""Asking the service for predictions, through its warm-up and its absences."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from koop_clients.queries import NO_REPLY, KoopClient, KoopError
from koop_protocol import ErrorCode, PredictReply

# What passes by itself; any other refusal will not change, and ends the run.
_WARMING_UP = (ErrorCode.warming_up, ErrorCode.unknown_trajectory)
_PASSING = (*_WARMING_UP, ErrorCode.overloaded, ErrorCode.internal, NO_REPLY)
_PATIENCE = 10.0  # s without any answer, or with "unknown trajectory"


class Asker:
    """Puts questions to the service and keeps account of how it answered.

    Attributes:
        standing: in a few words, such as "warming up, 12 of 36 frames"; "" once it answers.
        latencies: the last answers' round trips [s].
        refused: questions that got no answer.
    """

    def __init__(self, client: KoopClient) -> None:
        self._client = client
        self._silent_since: float | None = None
        self.standing = "waiting for the first answer"
        self.latencies: deque[float] = deque(maxlen=10_000)
        self.refused = 0

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
        self.standing, self._silent_since = "", None
        return reply

    def _on_refusal(self, error: KoopError) -> None:
        if error.code not in _PASSING:
            raise error
        self.refused += error.code not in _WARMING_UP
        self.standing = _in_few_words(error)
        if error.code == ErrorCode.warming_up:
            self._silent_since = None
            return
        now = time.monotonic()
        self._silent_since = self._silent_since or now
        if now - self._silent_since > _PATIENCE:
            raise error


def _in_few_words(error: KoopError) -> str:
    frames, needed = error.details.get("frames"), error.details.get("warmup_frames")
    if error.code == ErrorCode.warming_up and frames is not None and needed is not None:
        return f"warming up, {frames} of {needed} frames"
    words = {
        ErrorCode.warming_up: "warming up",
        ErrorCode.unknown_trajectory: "the service has not seen a frame yet",
        NO_REPLY: "the service does not answer",
    }
    return words.get(error.code, error.message)
