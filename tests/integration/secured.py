"""A service behind the shipped deploy files, on loopback, with certificates made for the test."""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import zenoh
from integration.loopback import DEADLINE, RENDERER, Source, picture

from koop_clients.connection import flush, open_session
from koop_clients.pki.deployment import Deployment
from koop_clients.pki.register import read_parties
from koop_clients.pki.storage import CONFIGURATION
from koop_clients.queries import NO_REPLY, KoopClient, KoopError
from koop_protocol import CLIENT_TOKENS, SOURCE_TOKENS, LqrQuery
from koop_service.assembly import Service, running
from koop_service.serving.config import ModelRule, NetworkSettings, ServiceConfig
from koop_service.serving.session import open_session as open_hub

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
ROBOT, OTHER = "line3/robot7", "line3/robot8"  # as the deployment has them
FRAMES = 40  # past the warm-up
QUERY = LqrQuery(10, picture(0, 100), u_min=-np.ones(1), u_max=np.ones(1), force=True)

HOST = "127.0.0.1"  # so that localhost, the same machine, is a wrong name
NOW = datetime.datetime.now(datetime.UTC)

EVERYTHING = ("**", CLIENT_TOKENS, SOURCE_TOKENS)  # ** leaves out chunks that begin with @

_EPOCHS = (f"{number:016x}" for number in itertools.count(1))


def deploy(folder: Path) -> Deployment:
    """The deployment in deploy/, with certificates."""
    deployment = Deployment(folder)
    deployment.begin([HOST], HOST, 7447, NOW)
    for party in read_parties(DEPLOY / "parties.toml"):
        deployment.add(party, NOW)
    return deployment


@dataclass(frozen=True)
class Secured:
    """A running service, and the certificates of those who may use it."""

    service: Service
    hub: zenoh.Session
    deployment: Deployment
    endpoint: str

    @property
    def port(self) -> int:
        return int(self.endpoint.rpartition(":")[2])

    def file(self, name: str) -> Path:
        return self.deployment.folder / name / CONFIGURATION

    def session(self, name: str, endpoint: str | None = None) -> zenoh.Session:
        """A session with this party's certificate; a context manager."""
        return open_session(endpoint or self.endpoint, config_file=self.file(name))

    def frames(self) -> float:
        """Frames that the service has folded in, of all trajectories."""
        return self.service.metrics.value("koop_frames_total")


@contextmanager
def secured(deployment: Deployment, state: Path, model: Path) -> Iterator[Secured]:
    """The service as its own hub, with the deployment's configuration; only the port is another."""
    network = NetworkSettings(zenoh_config=deployment.configuration, listen=(f"tls/{HOST}:0",))
    config = ServiceConfig(
        models=(ModelRule(model, ("line3/*",)),), state_folder=state, network=network
    )
    with open_hub(network) as hub, running(config, hub) as service:
        yield Secured(service, hub, deployment, service.endpoints[0])


def begin(session: zenoh.Session, name: str) -> Source:
    """A new stream of this trajectory, which replaces the former one."""
    return Source(session, name, epoch=next(_EPOCHS), renderer=RENDERER)


def stream(session: zenoh.Session, name: str, frames: int) -> Source:
    """Begin one, and wait until the hub has handed these frames on, or dropped them."""
    source = begin(session, name)
    source.stream(frames)
    flush(session)
    return source


class Witness:
    """What somebody received."""

    def __init__(self) -> None:
        self._seen: list[tuple[str, bytes]] = []

    @property
    def keys(self) -> list[str]:
        """Of everything."""
        return [key for key, _ in self._seen]

    def keys_of(self, payload: bytes) -> list[str]:
        """Of puts of this payload, and of deletes; what the service says is neither."""
        return [key for key, found in self._seen if found in (payload, b"")]

    def forget(self) -> None:
        """Begin anew."""
        self._seen.clear()

    def see(self, message: zenoh.Sample | zenoh.Query) -> None:
        """Take it down."""
        payload = message.payload
        self._seen.append((str(message.key_expr), b"" if payload is None else payload.to_bytes()))


@contextmanager
def overhearing(session: zenoh.Session, *keys: str) -> Iterator[Witness]:
    """What is put on the keys, and who comes and goes; the hub's own session hears all of it."""
    witness, keys = Witness(), keys or EVERYTHING
    callback = zenoh.handlers.Callback(witness.see, indirect=False)
    declared = [session.declare_subscriber(key, callback) for key in keys]
    declared += [session.liveliness().declare_subscriber(key, callback) for key in keys]
    flush(session)
    yield witness
    for declaration in declared:
        declaration.undeclare()


def put_everywhere(session: zenoh.Session, keys: list[str], payload: bytes) -> None:
    """By every means that a session has: put, delete, declared publisher."""
    block = zenoh.CongestionControl.BLOCK
    for key in keys:
        session.put(key, payload, congestion_control=block)
        session.delete(key, congestion_control=block)
        with session.declare_publisher(key, congestion_control=block) as publisher:
            publisher.put(payload)
            publisher.put(payload)
    flush(session)


def asking(session: zenoh.Session) -> KoopClient:
    """Patient: a busy machine takes its time, and who may not ask is told so at once."""
    return KoopClient(session, DEADLINE)


def silence(ask: Callable[[], object]) -> None:
    """The question gets no answer at all, not even a refusal by the service."""
    with pytest.raises(KoopError) as caught:
        ask()
    assert caught.value.code == NO_REPLY
