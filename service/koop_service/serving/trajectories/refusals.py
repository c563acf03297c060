"""Rejected measurements: counted by reason, logged with a brake, and remembered for the asker.

A put has no reply, so the service remembers why it rejected a trajectory's last message, and says
so when somebody asks about a trajectory that it does not know.
"""

from __future__ import annotations

import logging
from collections import OrderedDict

from koop_protocol import ProtocolError
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.instruments.metrics import Metrics

log = logging.getLogger("koop.measurements")

_REMEMBERED = 1000
"""Trajectories whose last rejection is remembered."""
_SHOWN = 200
"""Characters of a name that a log line shows."""


class Refusals:
    """Where every rejected message ends."""

    def __init__(self, metrics: Metrics, brake: Brake | None = None) -> None:
        self._metrics = metrics
        self._brake = brake or Brake()
        self._last: OrderedDict[str, ProtocolError] = OrderedDict()

    def note(self, lane: str, error: ProtocolError) -> None:
        """Count and log one rejection; `lane` is the trajectory as far as the key names one."""
        self._metrics.rejected.labels(str(error.code)).inc()
        self._remember(lane, error)
        held = self._brake.admit(str(error.code))
        if held is not None:
            more = f" ({held} more of the kind '{error.code}' since the last line)" if held else ""
            log.warning(
                "rejected a message of %r: %s%s",
                lane[:_SHOWN],
                error,
                more,
                extra={"reason": str(error.code), "trajectory": lane[:_SHOWN], "held_back": held},
            )

    def last(self, lane: str) -> ProtocolError | None:
        """Why the trajectory's last rejected message was rejected."""
        return self._last.get(lane)

    def _remember(self, lane: str, error: ProtocolError) -> None:
        # Where it was raised is of no use any more, and holds the message's bytes.
        error.__traceback__ = error.__cause__ = error.__context__ = None
        self._last[lane] = error
        self._last.move_to_end(lane)
        if len(self._last) > _REMEMBERED:
            self._last.popitem(last=False)
