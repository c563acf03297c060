"""Asking the service to take a plant over, without waiting for its answer."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.queries import KoopError
from koop_clients.sim_client.patience import Patience, in_few_words
from koop_protocol import ErrorCode, LqrReply

_LONGEST = round(10.0 / FRAME_INTERVAL)  # frames that a model may take to become fit


class Registration:
    """Asks at each frame until the task is granted, on a thread of `executor`.

    Attributes:
        reply: the answer that granted the task; None while it is not.
        standing: why it is not, in a few words.
        reasons: why the model was last found not fit for control.
        has_given_up: whether it was not fit for 10 s of frames.
    """

    def __init__(self, executor: Executor, trajectory: str, epoch: str) -> None:
        self._executor = executor
        self._trajectory = trajectory
        self._epoch = epoch
        self._patience = Patience()
        self._pending: Future[LqrReply] | None = None
        self._unfit_since: int | None = None
        self.reply: LqrReply | None = None
        self.standing = ""
        self.reasons: tuple[str, ...] = ()
        self.has_given_up = False

    def ask(self, begin: Callable[[], LqrReply]) -> None:
        """Ask, unless that is under way, is granted, or makes no sense any more."""
        if self._pending is None and self.reply is None and not self.has_given_up:
            self._pending = self._executor.submit(begin)

    def settle(self, number: int, wait: bool) -> None:
        """Take the answer in, if it is there or `wait` says to wait; frame `number` is the newest.

        Raises:
            KoopError: a refusal that waiting does not heal.
        """
        if self._pending is None or not (wait or self._pending.done()):
            return
        pending, self._pending = self._pending, None
        try:
            reply = pending.result()
        except KoopError as error:
            self._patience.try_with(error)
            self.standing = in_few_words(error)
        else:
            self._patience.restore()
            self._judge(reply, number)

    def lose(self, why: str) -> None:
        """The task is no more: ask again."""
        self.reply, self.standing = None, why

    def _judge(self, reply: LqrReply, number: int) -> None:
        if reply.epoch != self._epoch:
            raise another_source(self._trajectory)
        if reply.controls is not None:
            self.reply, self.standing, self._unfit_since = reply, "", None
            return
        self.reasons, self.standing = reply.reasons, "not fit for control yet"
        self._unfit_since = number if self._unfit_since is None else self._unfit_since
        self.has_given_up = number - self._unfit_since >= _LONGEST


def another_source(trajectory: str) -> KoopError:
    """The error where the service speaks of a stream that is not ours."""
    return KoopError(
        ErrorCode.stale_epoch,
        f"another source streams as {trajectory}; stop it, or choose other numbers with --first",
    )
