"""The baseline of [6] on koop's own wire: B is learned for all, A is fitted to each trajectory.

It stands in for koop-serve, which serves no baselines: it hears frames and controls, folds them by
the service's own stream and estimator, and answers tasks with commands by the same programme.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import zenoh

from koop_protocol import (
    CONTROLS,
    FRAMES,
    LQRS,
    STATES,
    Command,
    Control,
    EndReason,
    ErrorCode,
    ErrorReply,
    Frame,
    LqrCancel,
    LqrEnd,
    LqrReply,
    LqrTask,
    command_key,
    decode,
    encode,
)
from koop_service.control.problem import build_lqr
from koop_service.control.solve import solve_qp
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import load_weights
from koop_service.estimation.estimator import Bank
from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import Stream, Transition
from koop_service.learning.dynamics import load_learned
from koop_service.prediction.model import LinearModel

Array = np.ndarray


class LearnedInput:
    """One trajectory's estimate: the proximal fit of z_{t+1} - B u_t on the regressor without u."""

    def __init__(self, B: Array, settings: EstimatorSettings) -> None:
        self.stream = Stream(settings)
        self._B, self._settings = B, settings
        self._unforced = replace(settings, control_size=0, prior_mean=())
        self._bank = Bank(self._unforced, capacity=1)
        self._lane = self._bank.open()
        hn = settings.history * settings.code_size
        self._acts = slice(hn, hn + settings.control_size)

    def fold(self, transitions: list[Transition]) -> None:
        """Learn from what the stream completed."""
        for transition in transitions:
            w, y = np.delete(transition.w, self._acts), transition.y - self._B @ self._u(transition)
            self._bank.fold(np.array([self._lane]), w[None], y[None])

    def model(self) -> LinearModel:
        """The present model, the learned B in it."""
        fitted = self._bank.theta(self._lane)
        first = self._acts.start
        theta = np.concatenate([fitted[:, :first], self._B, fitted[:, first:]], axis=1)
        return LinearModel.from_theta(theta, self._settings)

    def _u(self, transition: Transition) -> Array:
        return transition.w[self._acts]


@dataclass(eq=False)
class _Trajectory:
    estimate: LearnedInput
    task: LqrTask | None = None
    target: Array = field(default_factory=lambda: np.zeros(0))


class LearnedControl:
    """The baseline's whole service; everything happens in one thread, in order of arrival."""

    def __init__(self, codec: ImageCodec, B: Array, settings: EstimatorSettings) -> None:
        self._codec, self._B, self._settings = codec, B, settings
        self._trajectories: dict[str, _Trajectory] = {}

    def measure(self, payload: bytes) -> Command | None:
        """Fold a frame or a control; the command of a task at a new frame."""
        message = decode(payload)
        if isinstance(message, Control):
            estimate = self._find(message.trajectory).estimate
            estimate.fold(estimate.stream.fold_control(message.epoch, message.seq, message.u))
        elif isinstance(message, Frame):
            found = self._find(message.trajectory)
            stream, before = found.estimate.stream, found.estimate.stream.next_seq
            code = self._codec.encode(message.image[None])[0]
            found.estimate.fold(stream.fold_frame(message.epoch, message.seq, code))
            if found.task is not None and stream.next_seq > before and stream.history is not None:
                return self._command(message.trajectory, found, found.task)
        return None

    def ask(self, trajectory: str, payload: bytes) -> LqrReply | LqrEnd | ErrorReply:
        """Begin or end a task."""
        order, found = decode(payload), self._find(trajectory)
        if isinstance(order, LqrCancel):
            found.task = None
            return LqrEnd(trajectory, order.owner, EndReason.cancelled, "its owner cancelled it")
        if not isinstance(order, LqrTask) or found.estimate.stream.history is None:
            return ErrorReply(
                ErrorCode.warming_up, "this baseline answers tasks on running streams"
            )
        query = order.query
        found.target = (
            self._codec.encode(np.asarray(query.target_image)[None])[0]
            if query.target_code is None
            else query.target_code
        )
        found.task = order
        first = self._command(trajectory, found, order)
        return LqrReply(
            trajectory,
            first.epoch,
            first.seq,
            first.status,
            first.cost,
            first.kkt_residual,
            first.controls,
        )

    def _find(self, name: str) -> _Trajectory:
        if name not in self._trajectories:
            self._trajectories[name] = _Trajectory(LearnedInput(self._B, self._settings))
        return self._trajectories[name]

    def _command(self, name: str, found: _Trajectory, task: LqrTask) -> Command:
        stream, query = found.estimate.stream, task.query
        history, seq = stream.history, stream.next_seq - 1
        assert history is not None  # both callers looked
        solution = solve_qp(
            build_lqr(
                found.estimate.model(),
                history,
                found.target,
                query.horizon,
                query.q,
                query.r,
                query.u_min,
                query.u_max,
            )
        )
        finite = np.isfinite([solution.cost, solution.kkt_residual]).all()
        return Command(
            name,
            stream.epoch or "",
            seq,
            seq,
            solution.u,
            solution.status,
            solution.cost if finite else 0.0,
            solution.kkt_residual if finite else 0.0,
            task.owner,
        )


@contextmanager
def serving(session: zenoh.Session, weights: Path, settings: EstimatorSettings) -> Iterator[None]:
    """Serve the baseline in `weights` on the session, with the estimator settings of ours."""
    learned = load_learned(weights)
    if learned is None or learned.kind != "learned-B":
        raise ValueError(
            f"{weights} holds no learned B; train one: koop-train --dynamics learned-B"
        )
    service = LearnedControl(ImageCodec(*load_weights(weights)), learned.matrix, settings)
    work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()

    def measured(sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()

        def fold() -> None:
            command = service.measure(payload)
            if command is not None:
                session.put(command_key(command.trajectory), encode(command), express=True)

        work.put(fold)

    def asked(query: zenoh.Query) -> None:
        payload, key = query.payload, str(query.key_expr)

        def answer() -> None:
            if payload is None:
                error = ErrorReply(ErrorCode.unknown_trajectory, "the baseline tells no state")
                query.reply_err(encode(error))
            else:
                reply = service.ask(key.split("/", 2)[-1], payload.to_bytes())
                if isinstance(reply, ErrorReply):
                    query.reply_err(encode(reply))
                else:
                    query.reply(key, encode(reply))
            query.drop()

        work.put(answer)

    thread = threading.Thread(target=_work_off, args=(work,), name="koop-learned-b", daemon=True)
    thread.start()
    declared = [session.declare_subscriber(key, measured) for key in (FRAMES, CONTROLS)]
    declared += [session.declare_queryable(key, asked) for key in (LQRS, STATES)]
    try:
        yield
    finally:
        for item in declared:
            item.undeclare()
        work.put(None)
        thread.join()


def _work_off(work: queue.SimpleQueue[Callable[[], None] | None]) -> None:
    while (item := work.get()) is not None:
        item()
