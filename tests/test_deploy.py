"""deploy/ is what koop-pki writes, and by default nothing listens beyond this machine.

python tests/test_deploy.py    writes deploy/ anew, after a change of the templates
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import zenoh

from koop_clients.pki.configurations import hub_configuration, leaf_configuration
from koop_clients.pki.party import Party
from koop_clients.pki.register import read_parties, to_toml

DEPLOY = Path(__file__).resolve().parents[1] / "deploy"
HOST, PORT = "127.0.0.1", 7447

EXAMPLE = [
    Party("robot7", publishes=("line3/robot7",)),
    Party("robot8", publishes=("line3/robot8",)),
    Party("cartpole", publishes=("cartpole-actuated/0",), operates=("cartpole-actuated/0",)),
    Party("operator", operates=("line3/*",)),
    Party("wall", views=("**",)),
    Party("recorder", records=("line3/*",)),
    Party("service", serves=True),
]
"""A robot of each kind, and those who look on."""


def shipped() -> dict[str, str]:
    """File in deploy/ -> its text."""
    leaf, service = EXAMPLE[0], EXAMPLE[-1]
    return {
        "parties.toml": to_toml(EXAMPLE),
        "hub.json5": hub_configuration(HOST, PORT, EXAMPLE),
        "leaf.json5": leaf_configuration(HOST, PORT, leaf),
        "service.json5": leaf_configuration(HOST, PORT, service),
    }


def test_the_shipped_files_are_what_the_command_writes() -> None:
    files = {path.name: path.read_text() for path in DEPLOY.iterdir() if path.is_file()}
    assert files == shipped()
    assert read_parties(DEPLOY / "parties.toml") == EXAMPLE


@pytest.mark.parametrize("name", ["hub.json5", "leaf.json5", "service.json5"])
def test_zenoh_reads_them_and_they_speak_tls_only(name: str) -> None:
    config = zenoh.Config.from_file(DEPLOY / name)
    assert json.loads(config.get_json("transport/link/protocols")) == ["tls"]
    assert json.loads(config.get_json("transport/link/tls/enable_mtls")) is True
    assert json.loads(config.get_json("transport/link/tls/close_link_on_expiration")) is True
    assert json.loads(config.get_json("transport/shared_memory/enabled")) is False
    for scouting in ("multicast", "gossip"):
        assert json.loads(config.get_json(f"scouting/{scouting}/enabled")) is False


def test_the_shipped_hub_listens_on_loopback_and_denies_by_default() -> None:
    config = zenoh.Config.from_file(DEPLOY / "hub.json5")
    endpoints = json.loads(config.get_json("listen/endpoints"))
    assert [endpoint.partition("#")[0] for endpoint in endpoints] == [f"tls/{HOST}:{PORT}"]
    rules = json.loads(config.get_json("access_control"))
    assert rules["enabled"] is True
    assert rules["default_permission"] == "deny"


if __name__ == "__main__":
    for file, text in shipped().items():
        (DEPLOY / file).write_text(text)
