"""Questions to the koop service: predictions, controls to a target, and how a trajectory stands.

Needs numpy, msgpack and eclipse-zenoh, nothing else.

    Exception
    └── KoopError      the service refused, did not answer, or answered nonsense
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TypeVar

import numpy as np
import zenoh
from numpy.typing import ArrayLike

from koop_protocol import (
    HEALTH,
    PREDICTIONS,
    ErrorReply,
    Health,
    Limits,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    PredictQuery,
    PredictReply,
    ProtocolError,
    StateReply,
    decode_as,
    encode,
    lqr_key,
    predict_key,
    state_key,
)

NO_REPLY = "no_reply"
"""Code of a KoopError when nothing came back in time; every other code is the service's."""

DEFAULT_TIMEOUT = 2.0  # s

# Pictures asked for, or given as targets, may be large; how large, the service says. It gets no
# more than this from Zenoh.
_LIMITS = Limits(max_message_bytes=64 << 20)

R = TypeVar("R", PredictReply, LqrReply, LqrEnd, StateReply, Health)


class KoopError(Exception):
    """No answer, and why not.

    Attributes:
        code: an ErrorCode of the protocol such as "warming_up", or NO_REPLY.
        message: what was wrong, what was expected and what to do.
        details: values for a program, such as `frames` and `warmup_frames` of "warming_up".
    """

    def __init__(
        self, code: str, message: str, details: Mapping[str, str | int | float] | None = None
    ) -> None:
        super().__init__(code, message, details)
        self.code = code
        self.message = message
        self.details = dict(details or {})

    def __str__(self) -> str:
        return self.message


class KoopClient:
    """Asks the service about trajectories, its own or anybody's. Thread-safe, as the session is.

    Every question waits at most `timeout` seconds. Arguments that break the protocol raise
    ProtocolError before anything is sent; whatever else keeps the answer away is a
    KoopError.
    """

    def __init__(self, session: zenoh.Session, timeout: float = DEFAULT_TIMEOUT) -> None:
        self._session = session
        self._timeout = timeout

    def predict(
        self,
        trajectory: str,
        horizon: int,
        controls: ArrayLike | None = None,
        returns: Iterable[str] = ("codes",),
        *,
        timeout: float | None = None,
    ) -> PredictReply:
        """The `horizon` frames that follow the last one the service has taken in.

        Args:
            trajectory: its name.
            horizon: how many frames H.
            controls: (H, p), row i acts before predicted frame i arrives; None: the last control is
                held.
            returns: what to send back, of "codes", "frames" and "std".
            timeout: how long to wait [s]; None is the client's own.
        """
        query = _predict_query(horizon, controls, returns)
        return self._ask(PredictReply, predict_key(trajectory), encode(query), timeout)

    def predict_all(
        self,
        horizon: int,
        returns: Iterable[str] = ("codes",),
        *,
        timeout: float | None = None,
    ) -> dict[str, PredictReply]:
        """Predictions of all trajectories that are ready, by name; the last controls are held.

        Raises KoopError when there is none, with the first refusal where there was one.
        """
        payload = encode(_predict_query(horizon, None, returns))
        found: dict[str, PredictReply] = {}
        refusal: KoopError | None = None
        for answer in self._answers(PredictReply, PREDICTIONS, payload, timeout):
            if isinstance(answer, KoopError):
                refusal = refusal or answer
            else:
                found[answer.trajectory] = answer
        if not found:
            raise refusal or _no_reply(PREDICTIONS, self._seconds(timeout))
        return found

    def lqr(self, trajectory: str, query: LqrQuery, *, timeout: float | None = None) -> LqrReply:
        """Controls that bring the trajectory to the query's target."""
        return self._ask(LqrReply, lqr_key(trajectory), encode(query, _LIMITS), timeout)

    def begin(self, trajectory: str, task: LqrTask, *, timeout: float | None = None) -> LqrReply:
        """Register a task, or replace its owner's former one; the first plan.

        The owner's liveliness token must be declared: :class:`koop_clients.control.Controller`
        does so. No task has begun where the reply says that the model is not fit.
        """
        return self._ask(LqrReply, lqr_key(trajectory), encode(task, _LIMITS), timeout)

    def cancel(self, trajectory: str, owner: str, *, timeout: float | None = None) -> LqrEnd:
        """End the owner's task."""
        return self._ask(LqrEnd, lqr_key(trajectory), encode(LqrCancel(owner)), timeout)

    def state(self, trajectory: str, *, timeout: float | None = None) -> StateReply:
        """How the trajectory's estimator stands."""
        return self._ask(StateReply, state_key(trajectory), None, timeout)

    def health(self, *, timeout: float | None = None) -> list[Health]:
        """What each worker says of itself; one that is stuck says nothing, and takes the timeout.

        Raises KoopError (no_reply) where none answered.
        """
        answers = self._answers(Health, HEALTH, None, timeout)
        found = [answer for answer in answers if isinstance(answer, Health)]
        if not found:
            raise _no_reply(HEALTH, self._seconds(timeout))
        return found

    def _ask(self, kind: type[R], key: str, payload: bytes | None, timeout: float | None) -> R:
        """The first answer; a refusal only counts once every worker has spoken."""
        refusal: KoopError | None = None
        for answer in self._answers(kind, key, payload, timeout):
            if not isinstance(answer, KoopError):
                return answer
            refusal = refusal or answer
        raise refusal or _no_reply(key, self._seconds(timeout))

    def _answers(
        self, kind: type[R], key: str, payload: bytes | None, timeout: float | None
    ) -> Iterator[R | KoopError]:
        replies = self._session.get(
            key,
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=self._seconds(timeout),
        )
        for reply in replies:
            answer = _read(kind, reply)
            if answer is not None:
                yield answer

    def _seconds(self, timeout: float | None) -> float:
        return self._timeout if timeout is None else timeout


def _predict_query(
    horizon: int, controls: ArrayLike | None, returns: Iterable[str]
) -> PredictQuery:
    rows = None if controls is None else np.asarray(controls, np.float64)
    return PredictQuery(horizon, rows, frozenset(returns))


def _read(kind: type[R], reply: zenoh.Reply) -> R | KoopError | None:
    """An answer, a refusal, or None for Zenoh's own note that the time is over."""
    if reply.ok is None:
        return _refusal(bytes(reply.err.payload) if reply.err else b"")
    try:
        return decode_as(kind, bytes(reply.ok.payload), _LIMITS)
    except ProtocolError as error:
        return KoopError(
            error.code,
            f"the reply on {reply.ok.key_expr} is not koop's: {error}; check that client and "
            "service are of the same version",
        )


def _refusal(payload: bytes) -> KoopError | None:
    try:
        refusal = decode_as(ErrorReply, payload)
    except ProtocolError:
        return None
    return KoopError(refusal.code, refusal.message, refusal.details)


def _no_reply(key: str, seconds: float) -> KoopError:
    return KoopError(
        NO_REPLY,
        f"nobody answered on {key} (waiting up to {seconds:g} s); check that `koop-serve` runs, "
        "that this session is connected to it and, where the hub has access rules, that they let "
        f"this certificate ask; of several workers, {_silent(key)}",
    )


def _silent(key: str) -> str:
    """What it means where they are there and none speaks."""
    if "*" in key:
        return "that no trajectory matches is for none of them to say"
    return "the worker that has this trajectory may be restarting: ask again"
