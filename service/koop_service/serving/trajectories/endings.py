"""Tells whoever watches `koop/state/<trajectory>` that a run of it is over."""

from __future__ import annotations

import logging
from collections.abc import Callable

from koop_protocol import Ending, TrajectoryEnd, encode, state_key
from koop_service.serving.instruments.logs import Brake

log = logging.getLogger("koop.trajectories")

_WORDS = {
    Ending.replaced_epoch: "its source began a new epoch",
    Ending.source_gone: "its source is gone; what was learned stays",
    Ending.evicted: "it was idle and lies on disk now; its next message or query brings it back",
}


class Endings:
    """`send` puts a payload on a key and never waits."""

    def __init__(self, send: Callable[[str, bytes], None]) -> None:
        self._send = send
        self._brake = Brake()

    def tell(self, trajectory: str, epoch: str, next_seq: int, reason: Ending) -> None:
        """This run is over. Nobody has to hear it, so that nothing is raised."""
        end = TrajectoryEnd(trajectory, epoch, next_seq, reason, _WORDS[reason])
        log.debug("%s: %s", trajectory, end.message)
        try:
            self._send(state_key(trajectory), encode(end))
        except Exception:
            if self._brake.admit("end") is not None:
                log.exception("an end could not be told; the service goes on")
