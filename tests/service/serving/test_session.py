"""What the options make of Zenoh's configuration."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import pytest

from koop_service.serving.config import NetworkSettings
from koop_service.serving.session import (
    CannotListenError,
    UnreachableError,
    open_session,
    zenoh_config,
)


def value(settings: NetworkSettings, key: str) -> object:
    return json.loads(zenoh_config(settings).get_json(key))


def test_by_default_it_is_a_hub_on_loopback_that_nobody_can_scout() -> None:
    settings = NetworkSettings()
    assert value(settings, "mode") == "router"
    assert value(settings, "listen/endpoints") == ["tcp/127.0.0.1:7447"]
    assert value(settings, "scouting/multicast/enabled") is False
    assert value(settings, "scouting/gossip/enabled") is False
    assert value(settings, "transport/shared_memory/enabled") is False


def test_connecting_makes_it_a_client_and_listening_too_a_router() -> None:
    joined = NetworkSettings(connect=("tcp/router:7447",))
    assert value(joined, "mode") == "client"
    assert value(joined, "connect/endpoints") == ["tcp/router:7447"]
    both = NetworkSettings(connect=("tcp/router:7447",), listen=("tcp/127.0.0.1:7448",))
    assert value(both, "mode") == "router"


def test_a_raw_file_decides_alone_and_options_act_on_top_of_it(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text('{mode: "peer", listen: {endpoints: ["tcp/127.0.0.1:7500"]}}')
    alone = NetworkSettings(zenoh_config=path)
    assert value(alone, "mode") == "peer"
    assert value(alone, "listen/endpoints") == ["tcp/127.0.0.1:7500"]
    assert value(alone, "transport/shared_memory/enabled") is True
    over = NetworkSettings(zenoh_config=path, listen=("tcp/127.0.0.1:7501",))
    assert value(over, "mode") == "router"
    assert value(over, "listen/endpoints") == ["tcp/127.0.0.1:7501"]


def test_a_broken_raw_file_is_explained(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text("{mode: ")
    with pytest.raises(OSError, match="is not a Zenoh configuration"):
        zenoh_config(NetworkSettings(zenoh_config=path))


def test_certificates_lie_beside_the_file_that_names_them(tmp_path: Path) -> None:
    tls = {"root_ca_certificate": "ca.pem", "listen_private_key": str(tmp_path / "key.pem")}
    path = tmp_path / "zenoh.json5"
    path.write_text(json.dumps({"mode": "router", "transport": {"link": {"tls": tls}}}))
    for file in ("ca.pem", "key.pem"):
        with pytest.raises(OSError, match=f"but there is no file {tmp_path / file}"):
            zenoh_config(NetworkSettings(zenoh_config=path))
        (tmp_path / file).touch()
    settings = NetworkSettings(zenoh_config=path)
    found = value(settings, "transport/link/tls")
    assert found["root_ca_certificate"] == str(tmp_path / "ca.pem")
    assert found["listen_private_key"] == str(tmp_path / "key.pem")


def test_idle_sockets_keep_nobody_out_for_long_by_default() -> None:
    assert value(NetworkSettings(), "transport/unicast/accept_timeout") == 2000


def test_a_router_that_is_not_there_yet_is_named(tmp_path: Path) -> None:
    told = r"no router at tcp/127\.0\.0\.1:1 yet$"
    with pytest.raises(UnreachableError, match=told):
        open_session(NetworkSettings(connect=("tcp/127.0.0.1:1",)))
    path = tmp_path / "zenoh.json5"
    path.write_text('{mode: "client", connect: {endpoints: ["tls/127.0.0.1:1"]}}')
    with pytest.raises(UnreachableError, match="or one refuses the certificates"):
        open_session(NetworkSettings(zenoh_config=path))


def test_a_taken_port_in_a_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        text = {"mode": "router", "listen": {"endpoints": {"router": [f"{endpoint}#iface=lo"]}}}
        path.write_text(json.dumps(text))
        with pytest.raises(CannotListenError, match=f"^{endpoint} is already taken"):
            open_session(NetworkSettings(zenoh_config=path))


def test_a_taken_port_says_what_to_do() -> None:
    told = str(CannotListenError(("tcp/127.0.0.1:7447",), "Address already in use"))
    assert "already taken" in told
    assert "--connect tcp/127.0.0.1:7447" in told
