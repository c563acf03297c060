"""Which refusals pass by themselves, and for how long a silent service is put up with."""

from __future__ import annotations

import time

from koop_clients.queries import NO_REPLY, KoopError
from koop_protocol import ErrorCode

PASSING = frozenset(
    {
        ErrorCode.warming_up,
        ErrorCode.unknown_trajectory,
        ErrorCode.overloaded,
        ErrorCode.internal,
        NO_REPLY,
    }
)
"""Any other refusal will not change while the stream stays what it is."""

_LIVELY = frozenset({ErrorCode.warming_up, ErrorCode.overloaded})
"""... and these say that the service lives, and will answer."""

_LONGEST = 10.0  # s


class Patience:
    """Runs out with a refusal that lasts, or after 10 s without a sign that the service lives."""

    def __init__(self) -> None:
        self._since: float | None = None

    def restore(self) -> None:
        """The service answered."""
        self._since = None

    def try_with(self, error: KoopError) -> None:
        """Put up with a refusal, or raise it."""
        if error.code not in PASSING:
            raise error
        if error.code in _LIVELY:
            self.restore()
            return
        now = time.monotonic()
        self._since = now if self._since is None else self._since
        if now - self._since > _LONGEST:
            message = f"for {_LONGEST:g} s now, {explained(error)}"
            raise KoopError(error.code, message, error.details)


def explained(error: KoopError) -> str:
    """A refusal, and what it means where the trajectory was streamed all the time."""
    if error.code != ErrorCode.unknown_trajectory or "refused" in error.details:
        return error.message
    return (
        f"{error.message}. Frames were put all the time; where the hub has access rules, they do "
        "not let this certificate publish it"
    )


def in_few_words(error: KoopError) -> str:
    """A refusal as a progress row tells it."""
    frames, needed = error.details.get("frames"), error.details.get("warmup_frames")
    if error.code == ErrorCode.warming_up and frames is not None and needed is not None:
        return f"warming up, {frames} of {needed} frames"
    words = {
        ErrorCode.warming_up: "warming up",
        ErrorCode.unknown_trajectory: "the service has not seen a frame yet",
        NO_REPLY: "the service does not answer",
    }
    return words.get(error.code, error.message)
