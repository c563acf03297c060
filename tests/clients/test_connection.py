"""Opening a session: what each thing that can be wrong is called."""

from __future__ import annotations

import datetime
import json
import shutil
import socket
import ssl
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest
import zenoh
from cryptography.hazmat.primitives import serialization

from koop_clients.connection import NoServiceError, RefusedError, open_session
from koop_clients.pki.deployment import Deployment
from koop_clients.pki.party import Party
from koop_clients.pki.storage import load_identity
from koop_clients.refusal import Credentials, _answer_of_hub


@pytest.fixture
def leaf(tmp_path: Path) -> Path:
    """The folder of a viewer, with good certificates."""
    now = datetime.datetime.now(datetime.UTC)
    deployment = Deployment(tmp_path / "pki")
    deployment.begin(["127.0.0.1"], "127.0.0.1", 7447, now)
    return deployment.add(Party("wall", views=("**",)), now)


def test_a_configuration_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no Zenoh configuration at"):
        open_session(config_file=tmp_path / "zenoh.json5")


def test_a_configuration_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "zenoh.json5").write_text("{mode: ")
    with pytest.raises(ValueError, match="is not a Zenoh configuration"):
        open_session(config_file=tmp_path / "zenoh.json5")


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("ca.pem", "root_ca_certificate"),
        ("cert.pem", "connect_certificate"),
        ("key.pem", "connect_private_key"),
    ],
)
def test_a_certificate_that_is_not_there(leaf: Path, file: str, name: str) -> None:
    (leaf / file).unlink()
    with pytest.raises(ValueError, match=f"names {file} as its {name}, but there is no file"):
        open_session(config_file=leaf / "zenoh.json5")


def test_an_absolute_path_stays_what_it_is(leaf: Path, tmp_path: Path) -> None:
    """So the error is about the certificate that it names, and not about one beside the file."""
    moved = tmp_path / "elsewhere" / "zenoh.json5"
    moved.parent.mkdir()
    text = (leaf / "zenoh.json5").read_text()
    for file in ("ca.pem", "cert.pem", "key.pem"):
        text = text.replace(f'"{file}"', f'"{leaf / file}"')
    moved.write_text(text)
    with pytest.raises(NoServiceError):
        open_session("tls/127.0.0.1:1", config_file=moved)


def encrypt_key(leaf: Path) -> None:
    key = load_identity(leaf).key
    secret = serialization.BestAvailableEncryption(b"secret")
    pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    (leaf / "key.pem").write_bytes(key.private_bytes(pem, pkcs8, secret))


def mix_up_keys(leaf: Path) -> None:
    shutil.copy(leaf.parent / "hub" / "key.pem", leaf)


def spoil_authority(leaf: Path) -> None:
    (leaf / "ca.pem").write_text("nonsense")


@pytest.mark.parametrize("spoil", [encrypt_key, mix_up_keys, spoil_authority])
def test_certificates_that_cannot_be_used(leaf: Path, spoil: Callable[[Path], None]) -> None:
    """Nor is anybody asked for a password."""
    spoil(leaf)
    with pytest.raises(ValueError, match="cannot be used together"):
        open_session(config_file=leaf / "zenoh.json5")


def test_an_endpoint_that_the_configuration_forbids(leaf: Path, endpoint: str) -> None:
    """A configuration for TLS is never used in plain text."""
    with pytest.raises(ValueError, match=r"does not allow tcp/.*; expected .* begins with tls/"):
        open_session(endpoint, config_file=leaf / "zenoh.json5")


@pytest.fixture
def impatient_hub() -> Iterator[str]:
    """One without TLS, which soon closes links that do not speak Zenoh."""
    settings = {
        "mode": "router",
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "adminspace/enabled": True,
        "transport/unicast/accept_timeout": 300,
    }
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        (reply,) = session.get(f"@/{session.zid()}/router")
        yield json.loads(reply.ok.payload.to_string())["locators"][0]


def test_a_hub_without_tls(leaf: Path, impatient_hub: str) -> None:
    """It is there, and that is said; a client without TLS gets in."""
    with open_session(impatient_hub):
        pass
    with pytest.raises(RefusedError, match="is there, but does not speak TLS"):
        open_session(impatient_hub.replace("tcp/", "tls/"), config_file=leaf / "zenoh.json5")


@pytest.mark.parametrize(
    ("error", "reason"),
    [(ssl.SSLEOFError(), "UNEXPECTED_EOF_WHILE_READING"), (ssl.SSLZeroReturnError(), "")],
)
def test_a_hub_that_closes_at_the_first_bytes_of_tls(error: ssl.SSLError, reason: str) -> None:
    error.reason = reason
    assert "does not speak TLS" in (_answer_of_hub(error, Credentials()) or "")


def test_something_that_is_no_hub() -> None:
    """Once it is over: it might have been one that was just starting."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        ThreadPoolExecutor(1) as pool,
    ):
        pool.submit(close_every_connection, server)
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(RefusedError, match="is there, but no Zenoh session comes about"):
            open_session(endpoint)
        server.shutdown(socket.SHUT_RDWR)


def close_every_connection(server: socket.socket) -> None:
    with suppress(OSError):
        while True:
            server.accept()[0].close()


@pytest.mark.parametrize("wait", [0.0, 0.3])
def test_nobody_is_there(leaf: Path, wait: float) -> None:
    with pytest.raises(NoServiceError, match=r"no koop service at tcp/127\.0\.0\.1:1; start one"):
        open_session("tcp/127.0.0.1:1", wait=wait)
    with pytest.raises(NoServiceError, match=r"no koop service at tls/127\.0\.0\.1:1; start one"):
        open_session("tls/127.0.0.1:1", config_file=leaf / "zenoh.json5", wait=wait)
