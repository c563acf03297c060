"""A measurement as it came: its key, its bytes, and whose turn it waits for."""

from __future__ import annotations

from dataclasses import dataclass

from koop_protocol import ProtocolError

STRANGERS = ""
"""The share of lanes that are not known; no lane has this name."""
_CONTROLS = "koop/control/"


@dataclass(slots=True)
class Arrival:
    """One measurement's bytes as they came, or what was wrong with them before they were read.

    `share` is whose room it takes; `taken` marks what a short cut took out of turn. `at` is when it
    came, by time.monotonic [s]. `replayed`: it came out of a source's log, not from the queue.
    `stalled`: it was not folded, since the encoder failed, and is to be asked for again.
    """

    key: str
    data: bytes
    ticket: int
    fault: ProtocolError | None = None
    taken: bool = False
    at: float = 0.0
    replayed: bool = False
    stalled: bool = False
    share: str = STRANGERS

    @property
    def is_frame(self) -> bool:
        """By its key; what is neither frame nor control counts as one."""
        return not self.key.startswith(_CONTROLS)


def lane_of(key: str) -> str:
    """The part of a measurement's key that frames and controls of one trajectory share."""
    parts = key.split("/", 3)
    return parts[3] if len(parts) == 4 else key
