"""A whole service on this machine's loopback, and small clients for it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import zenoh

from koop_protocol import (
    Command,
    Control,
    ErrorReply,
    Frame,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrTask,
    Message,
    PredictQuery,
    PredictReply,
    StateReply,
    client_token,
    command_key,
    control_key,
    decode,
    encode,
    frame_key,
    lqr_key,
    predict_key,
    state_key,
)
from koop_service.assembly import Service, running
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.weights import EstimatorDefaults, ModelCard, save_weights
from koop_service.serving.config import (
    LimitSettings,
    ModelRule,
    NetworkSettings,
    ServiceConfig,
)
from koop_service.serving.session import open_session

RENDERER = "test-renderer"
WARMUP = 36  # frames: n = 8, h = 2, p = 1
DEADLINE = 30.0  # seconds; a test that meets it has failed


def write_model(folder: Path) -> Path:
    """An untrained model of its own renderer; all that the service does with it is real."""
    path = folder / "model.safetensors"
    card = ModelCard("test", RENDERER, 0.05, estimator=EstimatorDefaults(affine=False))
    save_weights(path, initialised(8, seed=0), card)
    return path


def config_for(folder: Path, model: Path, **limits: int) -> ServiceConfig:
    """A service on any free port, with one model for every trajectory called `cart...`."""
    return ServiceConfig(
        models=(ModelRule(model, ("cart*",)),),
        state_folder=folder / "state",
        network=NetworkSettings(listen=("tcp/127.0.0.1:0",)),
        limits=replace(LimitSettings(), **limits),
    )


class Inbox:
    """Commands and ends in the order of their arrival."""

    def __init__(self) -> None:
        self.messages: list[Command | LqrEnd] = []

    def put(self, sample: zenoh.Sample) -> None:
        message = decode(sample.payload.to_bytes())
        assert isinstance(message, Command | LqrEnd)
        self.messages.append(message)

    def of_frame(self, seq: int) -> Command:
        """The command of this frame, when it is there."""
        wait_until(lambda: any(c.seq == seq for c in self.commands()), f"the command of {seq}")
        return next(c for c in self.commands() if c.seq == seq)

    def end(self) -> LqrEnd:
        """The end of the task, when it is there."""
        wait_until(lambda: bool(self.ends()), "the end of the task")
        (end,) = self.ends()
        return end

    def commands(self) -> list[Command]:
        return [m for m in self.messages if isinstance(m, Command)]

    def ends(self) -> list[LqrEnd]:
        return [m for m in self.messages if isinstance(m, LqrEnd)]


@dataclass
class Loop:
    """A running service and one client session."""

    service: Service
    session: zenoh.Session
    config: ServiceConfig

    def ask(self, key: str, payload: bytes | None = None) -> list[Message]:
        """All replies, errors decoded like the others."""
        return ask_all(self.session, key, payload)

    def ask_one(self, key: str, payload: bytes | None = None) -> Message:
        (reply,) = self.ask(key, payload)
        return reply

    def predict(self, name: str, query: PredictQuery | None = None) -> PredictReply | ErrorReply:
        return self.ask_one(predict_key(name), encode(query or PredictQuery(5)))

    def lqr(self, name: str, query: LqrQuery) -> Message:
        return self.ask_one(lqr_key(name), encode(query))

    @contextmanager
    def owner(self, name: str) -> Iterator[None]:
        """The client's session holds this owner's liveliness token."""
        token = self.session.liveliness().declare_token(client_token(name))
        try:
            yield
        finally:
            token.undeclare()

    @contextmanager
    def commands(self, name: str) -> Iterator[Inbox]:
        """What the service puts on the trajectory's command key."""
        inbox = Inbox()
        with self.session.declare_subscriber(command_key(name), inbox.put):
            yield inbox

    def task(self, name: str, order: LqrTask | LqrCancel) -> Message:
        return self.ask_one(lqr_key(name), encode(order))

    def state(self, name: str) -> StateReply:
        reply = self.ask_one(state_key(name))
        assert isinstance(reply, StateReply), reply
        return reply

    def rejected(self, reason: str) -> float:
        return self.service.metrics.value("koop_rejected_total", reason=reason)

    def lost(self) -> float:
        return self.service.metrics.value("koop_lost_total")


def ask_all(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[Message]:
    """All replies of all workers, errors decoded like the others."""
    replies = session.get(
        key,
        payload=payload,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=DEADLINE,
    )
    return [decode((r.ok or r.err).payload.to_bytes()) for r in replies]


@contextmanager
def loop(config: ServiceConfig) -> Iterator[Loop]:
    """Start service and client; both are gone at the end, and the state is stored."""
    with (
        open_session(config.network) as hub,
        running(config, hub) as service,
        client(service.endpoints[0]) as session,
    ):
        yield Loop(service, session, config)


@contextmanager
def client(endpoint: str) -> Iterator[zenoh.Session]:
    """A session as a source or a tool on the same machine opens it."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 600_000_000,
    }.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def picture(seed: int, step: int) -> np.ndarray:
    """A bright disc on a curve of its own, (64, 64) uint8."""
    y, x = np.mgrid[0:64, 0:64]
    phase = 0.13 * step + seed
    centre = 32 + 20 * np.array([np.sin(phase), np.cos(1.7 * phase)])
    distance = np.hypot(x - centre[0], y - centre[1])
    return np.clip(255 * (9 - distance), 0, 255).astype(np.uint8)


def control(seed: int, step: int) -> np.ndarray:
    return np.array([np.sin(0.7 * step + seed)])


@dataclass
class Source:
    """One trajectory's stream."""

    session: zenoh.Session
    name: str
    seed: int = 0
    epoch: str = "00000000000000aa"
    control_size: int = 1
    renderer: str = RENDERER

    @property
    def frame_key(self) -> str:
        return frame_key(self.name)

    def frame(self, seq: int, **changes: object) -> Frame:
        frame = Frame(
            self.name,
            self.epoch,
            seq,
            self.control_size,
            picture(self.seed, seq),
            self.renderer,
        )
        return replace(frame, **changes)

    def control(self, seq: int) -> Control:
        return Control(self.name, self.epoch, seq, control(self.seed, seq))

    def put(self, message: Frame | Control) -> None:
        key = (frame_key if isinstance(message, Frame) else control_key)(self.name)
        self.put_raw(key, encode(message))

    def put_raw(self, key: str, payload: bytes) -> None:
        self.session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def stream(self, stop: int, start: int = 0) -> None:
        """Frames start ... stop-1, and the controls between them."""
        for seq in range(start, stop):
            self.put(self.frame(seq))
            if self.control_size and seq < stop - 1:
                self.put(self.control(seq))


def wait_until(condition: Callable[[], bool], what: str = "the condition") -> None:
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not come about"
        time.sleep(0.01)


def burst(endpoint: str, first: int, trajectories: int, frames: int) -> None:
    """Everything packed beforehand, then put as fast as the service takes it."""
    with client(endpoint) as session:
        sources = [
            Source(session, f"cart/{first + i}", seed=first + i, control_size=0)
            for i in range(trajectories)
        ]
        packed = [(s, encode(s.frame(seq))) for seq in range(frames) for s in sources]
        for source, payload in packed:
            source.put_raw(source.frame_key, payload)
        # Closing drops what is not sent yet; an answer proves that everything has arrived.
        list(session.get(f"koop/state/cart/{first}", timeout=DEADLINE))
