"""A source with a log, as the service knows it: whether it is there, and how its log answers.

Values only; times are the caller's [s].
"""

from __future__ import annotations

from dataclasses import dataclass, field

from koop_service.serving.replay.catchup import CatchUp

_FIRST_PAUSE, LONGEST_PAUSE = 0.05, 2.0
"""Seconds before a question that got no answer is asked again; doubled each time."""
PATIENCE = 30.0
"""Seconds that live messages wait for a log that does not answer; then it is done without."""
_GONE = 5.0
"""Seconds without a live message and without a token, after which a source is taken for gone."""


@dataclass(eq=False, slots=True)
class LoggedSource:
    """The source of one trajectory.

    here: its token is there. mute: its log does not answer, and is done without. asked: the number
    of the question under way, until its answer is folded. again: when to ask next.
    behind_since: when it fell behind. failing_since: when the first question failed since the last
    answer. held_at: when the newest live message was held. largest: of those [bytes].
    dropped: messages that its log has lost.
    """

    name: str
    catch_up: CatchUp = field(default_factory=CatchUp)
    here: bool = False
    mute: bool = False
    asked: int | None = None
    again: float = 0.0
    pause: float = _FIRST_PAUSE
    behind_since: float = 0.0
    failing_since: float | None = None
    held_at: float = 0.0
    largest: int = 0
    dropped: int = 0

    def come(self) -> None:
        """Its token is there, perhaps anew: its log is asked first, at once."""
        self.here, self.mute, self.asked = True, False, None
        self.again, self.pause = 0.0, _FIRST_PAUSE
        self.catch_up.start()

    def hold(self, size: int, now: float) -> None:
        """A live message of `size` bytes waits for the log."""
        self.held_at = now
        self.largest = max(self.largest, size)

    def answer(self) -> None:
        """Its log has answered; the answer is not folded yet."""
        self.pause, self.failing_since = _FIRST_PAUSE, None

    def fail(self, now: float, late: bool) -> None:
        """A question got nowhere; late: perhaps by the link's fault, and not by the log's."""
        if not late and self.failing_since is None:
            self.failing_since = now
        self.asked, self.again = None, now + self.pause
        self.pause = min(2 * self.pause, LONGEST_PAUSE)

    def is_gone(self, now: float) -> bool:
        """Whether nothing speaks for its being there."""
        return not self.here and now - self.held_at > _GONE

    def is_hopeless(self, now: float) -> bool:
        """Whether messages come that nobody can be asked about."""
        since = self.failing_since
        return since is not None and now - since > PATIENCE and now - self.held_at < _GONE
