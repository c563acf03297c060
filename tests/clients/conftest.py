"""A Zenoh hub for each test, on a port of its own, and a service that knows the plant by heart."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zenoh

from koop_clients.connection import open_session
from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import Simulator, State, hold, without_drift
from koop_clients.mechanics.systems import System, build_system
from koop_clients.sim_client import cli
from koop_clients.sim_client.arguments import parse_arguments
from koop_clients.sim_client.streaming import open_streams
from koop_protocol import (
    Command,
    Control,
    EndReason,
    ErrorReply,
    Frame,
    LqrCancel,
    LqrEnd,
    LqrReply,
    LqrTask,
    Message,
    PredictQuery,
    PredictReply,
    command_key,
    decode,
    decode_as,
    encode,
)

WARMUP = 10  # frames


@pytest.fixture
def hub() -> Iterator[zenoh.Session]:
    """A router session listening on loopback."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("scouting/delay", "0")
    config.insert_json5("adminspace/enabled", "true")
    with zenoh.open(config) as session:
        yield session


@pytest.fixture
def endpoint(hub: zenoh.Session) -> str:
    """Where the hub listens."""
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        for reply in hub.get(f"@/{hub.zid()}/router", timeout=1.0):
            if reply.ok is not None:
                locators = json.loads(reply.ok.payload.to_string())["locators"]
                if locators:
                    return str(locators[0])
    raise RuntimeError("the hub does not tell where it listens")


@pytest.fixture
def signals() -> Iterator[None]:
    """Puts the signal handlers back that a command installed."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


class Clairvoyant:
    """A service that simulates the plant itself: its predictions are right to the last bit.

    So any error that a client finds is a mistake in the client's numbering. Controls fold into the
    state, which therefore is exact only where the torque is held for each frame.

    Attributes:
        seen: all messages that came.
        tasks: the one that is registered, if there is one.
        unfit: how many tasks to refuse still, for lack of a model that is fit for control.
    """

    def __init__(self, session: zenoh.Session, system: System, start: State) -> None:
        self.seen: list[Message] = []
        self.tasks: list[LqrTask] = []
        self.unfit = 0
        self._session = session
        self._system = system
        self._simulator, self._renderer = Simulator(system), Renderer(system)
        self._states = [start]
        direct: Any = zenoh.handlers.Callback  # in the link's own thread, so in order
        self._declared = [
            session.declare_subscriber(f"koop/{kind}/**", direct(self._take, indirect=False))
            for kind in ("frame", "control")
        ]
        self._declared += [
            session.declare_queryable(f"koop/{kind}/**", direct(handler, indirect=False))
            for kind, handler in (
                ("predict", self._predict),
                ("lqr", self._lqr),
                ("state", self._state),
            )
        ]

    @property
    def frames(self) -> list[Frame]:
        """The frames that came."""
        return [message for message in self.seen if isinstance(message, Frame)]

    @property
    def controls(self) -> list[Control]:
        """The controls that came."""
        return [message for message in self.seen if isinstance(message, Control)]

    def _take(self, sample: zenoh.Sample) -> None:
        message = decode(bytes(sample.payload))
        self.seen.append(message)
        if isinstance(message, Frame):
            self._command(message)
            if not message.control_size:
                self._go(message.seq, 0.0)
        if isinstance(message, Control):
            self._go(message.seq, float(message.u[0]))

    def _go(self, seq: int, torque: float) -> None:
        self._states.append(self._follow(self._states[seq], torque))

    def _follow(self, state: State, torque: float) -> State:
        following, _ = self._simulator.frame(state, hold(torque), 0)
        return without_drift(self._system, following)

    def _predict(self, query: zenoh.Query) -> None:
        with query:
            last = self.frames[-1]
            if last.seq < WARMUP:
                details: dict[str, Any] = {"frames": last.seq + 1, "warmup_frames": WARMUP}
                query.reply_err(encode(ErrorReply("warming_up", "too few frames", details)))
                return
            asked = decode_as(PredictQuery, bytes(query.payload or b""))
            states, state = [], self._states[last.seq]
            for torque in (
                np.zeros(asked.horizon) if asked.controls is None else asked.controls[:, 0]
            ):
                state = self._follow(state, float(torque))
                states.append(state.q)
            frames = self._renderer.sequence(np.stack(states))
            reply = PredictReply(last.trajectory, last.epoch, last.seq, frames=frames)
            query.reply(query.key_expr, encode(reply))

    def _lqr(self, query: zenoh.Query) -> None:
        with query:
            asked = decode(bytes(query.payload or b""))
            self.seen.append(asked)
            if isinstance(asked, LqrCancel):
                last, self.tasks = self.frames[-1], []
                end = LqrEnd(last.trajectory, asked.owner, EndReason.cancelled, "it said so")
                query.reply(query.key_expr, encode(end))
            elif isinstance(asked, LqrTask):
                query.reply(query.key_expr, encode(self._begin(asked)))

    def _begin(self, task: LqrTask) -> LqrReply:
        last = self.frames[-1]
        who = (last.trajectory, last.epoch, last.seq)
        if self.unfit:
            self.unfit -= 1
            why, probing = ("the motor has hardly moved",), np.zeros((4, 1))
            return LqrReply(*who, "unfit", 0.0, 0.0, fit=False, reasons=why, probing=probing)
        self.tasks = [task]
        plan, start = self._plan(task, last.seq), last.seq + task.query.delay
        return LqrReply(*who, "solved", 1.0, 0.0, plan, start=start)

    def _plan(self, task: LqrTask, seq: int) -> np.ndarray:
        """A stiff PD law to the upright pole, as a plan that repeats its first torque."""
        state, pole = self._states[seq], self._system.pole
        torque = -40.0 * state.q[pole] - 8.0 * state.v[pole]
        bounded = np.clip(torque, task.query.u_min, task.query.u_max)
        return np.full((task.query.horizon, 1), bounded)

    def _command(self, frame: Frame) -> None:
        for task in self.tasks:
            start, plan = frame.seq + task.query.delay, self._plan(task, frame.seq)
            who = (frame.trajectory, frame.epoch, frame.seq)
            command = Command(*who, start, plan, "solved", 1.0, 0.0, task.owner)
            self._session.put(command_key(frame.trajectory), encode(command))

    def _state(self, query: zenoh.Query) -> None:
        with query:
            query.reply_err(encode(ErrorReply("unknown_trajectory", "no frame has come")))


@pytest.fixture
def clairvoyant(hub: zenoh.Session) -> Callable[[System, State], Clairvoyant]:
    """Starts a service that knows the given plant and its initial state."""
    return lambda system, start: Clairvoyant(hub, system, start)


@pytest.fixture
def command(
    endpoint: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    signals: None,
) -> Callable[..., tuple[str, str]]:
    """Runs the command; what it said on standard output and standard error."""
    del signals

    def run(*options: str, rate: str = "max") -> tuple[str, str]:
        given = ["koop-sim-client", "--connect", endpoint, "--rate", rate, *options]
        monkeypatch.setattr(sys, "argv", given)
        cli.main()
        return capsys.readouterr()

    return run


@pytest.fixture
def knowing(endpoint: str, clairvoyant):
    """A service that knows the first plant of the given options."""

    def start(*options: str):
        arguments = parse_arguments(list(options))
        system = build_system(arguments.system, arguments.physical.given)
        with open_session(endpoint) as session:
            streams = open_streams(arguments, system, 0.0, session)
            return clairvoyant(system, streams[0].plant.state)

    return start
