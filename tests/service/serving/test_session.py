"""What the options make of Zenoh's configuration."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from koop_service.serving.config import NetworkSettings
from koop_service.serving.session import CannotListenError, zenoh_config


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


def test_a_taken_port_says_what_to_do() -> None:
    told = str(CannotListenError(("tcp/127.0.0.1:7447",), "Address already in use"))
    assert "already taken" in told
    assert "--connect tcp/127.0.0.1:7447" in told
