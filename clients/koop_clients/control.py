"""Closed-loop control of one's own trajectory: the service sends a plan at every frame.

Needs numpy, msgpack and eclipse-zenoh, nothing else.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType

import numpy as np
import zenoh
from numpy.typing import NDArray

from koop_clients.queries import DEFAULT_TIMEOUT, KoopClient, KoopError
from koop_protocol import (
    Command,
    ErrorCode,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    Message,
    ProtocolError,
    client_token,
    command_key,
    decode,
)

Array = NDArray[np.float64]

_KEPT = 64  # plans
_TOKEN_TRIES, _TOKEN_PAUSE = 20, 0.05  # s; through a router a token may come after the question


@dataclass(frozen=True, eq=False)
class _Plan:
    """Controls from interval `start` on, computed from frame `seq`, here since `arrived` [s]."""

    seq: int
    start: int
    controls: Array
    arrived: float

    def row(self, seq: int) -> Array | None:
        """The control (p,) for the interval after frame `seq`, where the plan speaks of it."""
        index = seq - self.start
        return self.controls[index] if 0 <= index < len(self.controls) else None


class Controller:
    """One task of the service on one trajectory, and what its commands say.

    While it is open a liveliness token tells the service that somebody wants the commands; should
    the program die, they stop. The service computes a command at each new frame. Where one is late
    the rest of the last plan goes on. Thread-safe.

    Example::

        query = LqrQuery(10, target_image=upright, r=1e-3, u_min=-bound, u_max=bound)
        with Controller(session, "line3/robot7", query) as controller:
            if not controller.begin().fit:
                ...  # let the robot move some more, then begin again
            while controller.ended is None:
                seq = source.put_frame(camera.read())
                controller.wait(seq, timeout=0.02)  # a late command is no reason to stand still
                torque = controller.control(seq)
                torque = rest if torque is None else torque
                robot.apply(torque)
                source.put_control(torque)

    Attributes:
        trajectory: whose controls these are.
        owner: the name under which the service keeps the task.
    """

    def __init__(
        self,
        session: zenoh.Session,
        trajectory: str,
        query: LqrQuery,
        *,
        owner: str | None = None,
        seconds: float | None = None,
        frozen: bool = False,
        timeout: float = DEFAULT_TIMEOUT,
    ) -> None:
        """Declare the token and listen to commands; `begin` asks for them.

        Args:
            session: an open Zenoh session, see :func:`koop_clients.connection.open_session`.
            trajectory: its name.
            query: target, weights and bounds; it asks for no `returns`.
            owner: a name of one's own, letters, digits, "_", "." or "-"; None draws one.
            seconds: after which the task ends by itself [s].
            frozen: keep the model as it is at registration.
            timeout: the longest wait for an answer [s].

        Raises:
            ProtocolError: the trajectory's name, the owner's or the query is not valid.
        """
        self.trajectory = trajectory
        self.owner = owner or f"koop-{secrets.token_hex(8)}"
        self._task = LqrTask(self.owner, query, seconds, frozen)
        self._client = KoopClient(session, timeout)
        self._plans: deque[_Plan] = deque(maxlen=_KEPT)
        self._epoch: str | None = None
        self._ended: LqrEnd | None = None
        self._command: Command | None = None
        self._changed = threading.Condition()
        self._closed = False
        # In the link's own thread: a thread between would make every command later.
        handler = zenoh.handlers.Callback(self._on_sample, indirect=False)
        self._subscriber = session.declare_subscriber(command_key(trajectory), handler)
        self._token = session.liveliness().declare_token(client_token(self.owner))

    def begin(self) -> LqrReply:
        """Register the task; the first plan, or why the model is not fit and nothing has begun.

        Raises:
            KoopError: the service refused ("task_taken" names the other owner) or did not answer.
        """
        with self._changed:
            self._ended = None
        reply = self._register()
        if reply.controls is not None:
            self._on_reply(reply)
        return reply

    def change(self, query: LqrQuery) -> LqrReply:
        """Another target, other weights, another delay: replaces the task; as `begin`."""
        self._task = LqrTask(self.owner, query, self._task.seconds, self._task.frozen)
        return self.begin()

    def control(self, seq: int, newest: int | None = None) -> Array | None:
        """The control (p,) for the interval between frame `seq` and the next.

        The newest plan that speaks of that interval says so: the rest of the last one, where a
        command is late. None where there is none.

        Args:
            seq: number of the frame at which the interval begins.
            newest: leave out plans from frames after this one; None leaves out nothing.
        """
        with self._changed:
            plans = list(self._plans)
        # By frame, not by arrival: a reply may come after a command from a later frame.
        plans.sort(key=lambda plan: plan.seq)
        for plan in reversed(plans):
            row = plan.row(seq) if newest is None or plan.seq <= newest else None
            if row is not None:
                return row
        return None

    def wait(self, seq: int, timeout: float) -> bool:
        """Wait until the plan from frame `seq`, or a later one, is there; whether it is.

        Gives up after `timeout` [s], or when the task has ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._has(seq) or self._ended is not None, timeout)
            return self._has(seq)

    def arrived(self, seq: int) -> float | None:
        """When the plan from frame `seq` came, on the clock of time.monotonic() [s], if it did."""
        with self._changed:
            return next((plan.arrived for plan in self._plans if plan.seq == seq), None)

    @property
    def command(self) -> Command | None:
        """The newest command, with what the solver says of it."""
        return self._command

    @property
    def ended(self) -> LqrEnd | None:
        """The service's word that the task has ended; None while it goes on."""
        return self._ended

    def close(self) -> None:
        """Cancel the task, if there is one, and undeclare token and subscriber."""
        if self._closed:
            return
        self._closed = True
        try:
            if self._epoch is not None and self._ended is None:
                self._cancel()
        finally:
            self._token.undeclare()
            self._subscriber.undeclare()

    def __enter__(self) -> Controller:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _register(self) -> LqrReply:
        for _ in range(_TOKEN_TRIES - 1):
            try:
                return self._client.begin(self.trajectory, self._task)
            except KoopError as error:
                if error.code != ErrorCode.no_owner:
                    raise
                time.sleep(_TOKEN_PAUSE)
        return self._client.begin(self.trajectory, self._task)

    def _cancel(self) -> None:
        with suppress(KoopError):  # the token goes with us, and the task with the token
            self._client.cancel(self.trajectory, self.owner)

    def _has(self, seq: int) -> bool:
        return any(plan.seq >= seq for plan in self._plans)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        message = _read(sample)
        if not isinstance(message, Command | LqrEnd) or message.owner != self.owner:
            return
        if isinstance(message, LqrEnd):
            with self._changed:
                self._ended = message
                self._changed.notify_all()
            return
        self._command = message
        self._take(message.epoch, message.seq, message.start, message.controls)

    def _on_reply(self, reply: LqrReply) -> None:
        assert reply.controls is not None
        self._take(reply.epoch, reply.seq, reply.start, reply.controls)

    def _take(self, epoch: str, seq: int, start: int, controls: Array) -> None:
        plan = _Plan(seq, start, controls, time.monotonic())
        with self._changed:
            if epoch != self._epoch:  # of a source that has started anew: other numbers
                self._plans.clear()
                self._epoch = epoch
            self._plans.append(plan)
            self._changed.notify_all()


def _read(sample: zenoh.Sample) -> Message | None:
    try:
        return decode(bytes(sample.payload))
    except ProtocolError:
        return None
