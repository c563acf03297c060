"""Who gets through to the hub of the shipped configuration: real certificates over loopback.

Each refusal is told apart from a service that is not there: the client says that the hub is there
and why it does not let it in, and a good certificate gets in at the same moment.
"""

from __future__ import annotations

import datetime
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from integration.loopback import wait_until
from integration.secured import HOST, NOW, Secured

from koop_clients.connection import NoServiceError, RefusedError, open_session
from koop_clients.pki.certificates import (
    Identity,
    make_authority,
    make_client,
    make_server,
)
from koop_clients.pki.storage import CA, CONFIGURATION, load_identity, replace_identity
from koop_clients.sim_client import cli
from koop_protocol import FRAMES, frame_key
from koop_service.serving.config import NetworkSettings
from koop_service.serving.session import locators
from koop_service.serving.session import open_session as open_hub

DAY = datetime.timedelta(days=1)


@pytest.fixture
def authority(guarded: Secured) -> Identity:
    """The one that the hub trusts."""
    return load_identity(guarded.deployment.folder / "ca")


@pytest.fixture
def impostor(guarded: Secured, tmp_path: Path) -> Callable[[Identity], Path]:
    """The configuration of robot7 with another certificate."""

    def make(identity: Identity) -> Path:
        shutil.copytree(guarded.deployment.folder / "robot7", tmp_path / "impostor")
        replace_identity(tmp_path / "impostor", identity)
        return tmp_path / "impostor" / CONFIGURATION

    return make


def refused(guarded: Secured, file: Path, endpoint: str | None = None) -> str:
    """Why the hub, which lets robot7 in, does not let this one in."""
    with guarded.session("robot7"):
        pass
    with pytest.raises(RefusedError) as caught:
        open_session(endpoint or guarded.endpoint, config_file=file)
    return str(caught.value)


@contextmanager
def another_hub(file: Path) -> Iterator[str]:
    """A hub without a service; its endpoint."""
    with open_hub(NetworkSettings(zenoh_config=file, listen=(f"tls/{HOST}:0",))) as session:
        yield locators(session)[0]


def test_a_certificate_of_the_authority_gets_in(guarded: Secured) -> None:
    with guarded.session("robot7") as session:
        assert [str(router) for router in session.info.routers_zid()] == [str(guarded.hub.zid())]


def test_no_certificate(guarded: Secured, tmp_path: Path) -> None:
    folder = guarded.deployment.folder / "robot7"
    shutil.copy(folder / CA, tmp_path)
    lines = (folder / CONFIGURATION).read_text().splitlines(keepends=True)
    bare = [line for line in lines if "connect_" not in line and "enable_mtls" not in line]
    assert len(bare) == len(lines) - 3
    (tmp_path / CONFIGURATION).write_text("".join(bare))
    assert "asks for a certificate" in refused(guarded, tmp_path / CONFIGURATION)


def test_a_certificate_of_a_foreign_authority(
    guarded: Secured, impostor: Callable[[Identity], Path]
) -> None:
    file = impostor(make_client(make_authority(NOW), "robot7", NOW))
    assert "does not know the authority that signed" in refused(guarded, file)


def test_an_expired_certificate(
    guarded: Secured, authority: Identity, impostor: Callable[[Identity], Path]
) -> None:
    file = impostor(make_client(authority, "robot7", NOW - 2 * DAY, days=1))
    assert "has expired, or is not valid yet" in refused(guarded, file)


def test_a_certificate_of_tomorrow(
    guarded: Secured, authority: Identity, impostor: Callable[[Identity], Path]
) -> None:
    file = impostor(make_client(authority, "robot7", NOW + DAY))
    assert "has expired, or is not valid yet" in refused(guarded, file)


def test_the_certificate_of_a_hub_is_none_of_a_client(
    guarded: Secured, authority: Identity, impostor: Callable[[Identity], Path]
) -> None:
    file = impostor(make_server(authority, ["robot7"], NOW))
    assert "does not take" in refused(guarded, file)


def test_plain_tcp(guarded: Secured) -> None:
    with pytest.raises(RefusedError, match="takes TLS only; connect with a certificate"):
        open_session(f"tcp/{HOST}:{guarded.port}")


def test_a_name_that_the_hubs_certificate_is_not_for(guarded: Secured) -> None:
    told = refused(guarded, guarded.file("robot7"), f"tls/localhost:{guarded.port}")
    assert "its certificate is not for localhost" in told


@pytest.mark.parametrize(
    ("fake", "told"),
    [
        ("of a foreign authority", "is not from the authority in"),
        ("that has expired", "its certificate has expired"),
        ("of tomorrow", "its certificate is not valid yet"),
        ("of a robot", "is not a hub's, but somebody's who passes for it"),
    ],
)
def test_a_client_does_not_take_a_hub_with_a_certificate(
    guarded: Secured, authority: Identity, tmp_path: Path, fake: str, told: str
) -> None:
    """The same configuration as the real hub's, on another port, with another certificate."""
    identity = {
        "of a foreign authority": lambda: make_server(make_authority(NOW), [HOST], NOW),
        "that has expired": lambda: make_server(authority, [HOST], NOW - 2 * DAY, days=1),
        "of tomorrow": lambda: make_server(authority, [HOST], NOW + DAY),
        "of a robot": lambda: make_client(authority, "robot8", NOW),
    }[fake]()
    shutil.copytree(guarded.deployment.folder / "hub", tmp_path / "hub")
    replace_identity(tmp_path / "hub", identity)
    with another_hub(tmp_path / "hub" / CONFIGURATION) as endpoint:
        assert told in refused(guarded, guarded.file("robot7"), endpoint)


def test_where_nobody_listens_there_is_no_service_instead(guarded: Secured) -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))  # bound and not listening: connections are refused
        port = taken.getsockname()[1]
        with pytest.raises(NoServiceError, match="start one with `koop-serve`"):
            open_session(f"tls/{HOST}:{port}", config_file=guarded.file("robot7"))


def test_the_link_ends_with_the_certificate_and_comes_back_with_the_next_one(
    guarded: Secured, authority: Identity, impostor: Callable[[Identity], Path]
) -> None:
    """So a certificate is renewed by replacing files, under a running session."""
    soon = make_client(authority, "robot7", datetime.datetime.now(datetime.UTC), days=3 / 86400)
    file = impostor(soon)
    with open_session(guarded.endpoint, config_file=file) as session:
        assert session.info.routers_zid()
        wait_until(lambda: not session.info.routers_zid(), "the end of the link")
        replace_identity(file.parent, make_client(authority, "robot7", NOW))
        wait_until(lambda: bool(session.info.routers_zid()), "the next link")


def test_two_authorities_are_trusted_while_one_replaces_the_other(
    guarded: Secured, impostor: Callable[[Identity], Path], tmp_path: Path
) -> None:
    """Old and new leaves at an old and a new hub, where all have both authorities in ca.pem."""
    next_ = make_authority(NOW)
    new, old, hub = impostor(make_client(next_, "robot7", NOW)), tmp_path / "old", tmp_path / "hub"
    assert "does not know the authority that signed" in refused(guarded, new)
    shutil.copytree(guarded.deployment.folder / "robot7", old)
    shutil.copytree(guarded.deployment.folder / "hub", hub)
    for folder in (new.parent, old, hub):
        (folder / CA).write_bytes((folder / CA).read_bytes() + next_.certificate_pem)
    for identity in (load_identity(hub), make_server(next_, [HOST], NOW)):
        replace_identity(hub, identity)
        with another_hub(hub / CONFIGURATION) as endpoint:
            for file in (new, old / CONFIGURATION):
                with open_session(endpoint, config_file=file) as session:
                    assert session.info.routers_zid()


def test_sources_go_on_when_the_hub_starts_again(guarded: Secured) -> None:
    """As it must to read new rules; the same session, the same publisher."""
    file, key = guarded.deployment.configuration, frame_key("line3/robot7")
    with open_hub(NetworkSettings(zenoh_config=file, listen=(f"tls/{HOST}:0",))) as hub:
        endpoint = locators(hub)[0]
        session = open_session(endpoint, config_file=guarded.file("robot7"))
    again = NetworkSettings(zenoh_config=file, listen=(endpoint,))
    seen: list[bytes] = []
    with (
        session,
        session.declare_publisher(key) as publisher,
        open_hub(again) as hub,
        hub.declare_subscriber(FRAMES, lambda sample: seen.append(sample.payload.to_bytes())),
    ):
        wait_until(lambda: publisher.matching_status.matching, "a subscriber at the new hub")
        for number in range(5):
            publisher.put(bytes([number]))
        wait_until(lambda: len(seen) == 5, "what was put after the restart")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--connect", "tcp/HUB"], "takes TLS only; connect with a certificate: --zenoh-config"),
        (["--connect", "tls/HUB"], "not from an authority that this machine trusts"),
        (["--zenoh-config", "FOREIGN"], "does not know the authority that signed"),
        (["--zenoh-config", "MISSING"], "names ca.pem as its root_ca_certificate, but there is no"),
        (["--zenoh-config", "operator", "--wait", "0"], "that they let this certificate ask"),
    ],
)
def test_the_simulator_client_says_why_it_is_refused(
    guarded: Secured,
    impostor: Callable[[Identity], Path],
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    told: str,
) -> None:
    """In one sentence, at once, and without a traceback."""
    foreign = impostor(make_client(make_authority(NOW), "robot7", NOW))
    files = {
        "FOREIGN": str(foreign),
        "MISSING": str(shutil.copy(foreign, foreign.parent.parent)),
        "operator": str(guarded.file("operator")),
    }
    given = [files.get(o, o.replace("HUB", f"{HOST}:{guarded.port}")) for o in options]
    if "--connect" not in given:
        given += ["--connect", guarded.endpoint]
    monkeypatch.setattr("sys.argv", ["koop-sim-client", "--system", "pendulum", *given])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    assert str(caught.value).startswith("koop-sim-client: ")
    assert told in str(caught.value)
