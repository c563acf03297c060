"""By default nothing can be reached from another machine: the sockets themselves are looked at."""

from __future__ import annotations

import ipaddress
import json
import re
from dataclasses import replace
from pathlib import Path

import psutil
import yaml
from integration.loopback import config_for

from koop_clients.connection import DEFAULT_ENDPOINT
from koop_service.assembly import running
from koop_service.serving.config import MonitoringSettings, NetworkSettings, ServiceConfig
from koop_service.serving.session import open_session, zenoh_config

ROOT = Path(__file__).resolve().parents[2]


def sockets() -> set[tuple[str, int, str]]:
    """Address, port and state of what this process listens or receives on."""
    connections = psutil.Process().net_connections(kind="inet")
    return {(c.laddr.ip, c.laddr.port, c.status) for c in connections if not c.raddr}


def test_service_and_metrics_listen_on_loopback_alone(tmp_path: Path, model: Path) -> None:
    """Everything is as it is without options; only the ports are any free ones."""
    (endpoint,) = NetworkSettings().endpoints
    network = NetworkSettings(listen=(re.sub(r":\d+$", ":0", endpoint),))
    config = replace(
        config_for(tmp_path, model), network=network, monitoring=MonitoringSettings(metrics_port=0)
    )
    before = sockets()
    with open_session(network) as session, running(config, session) as service:
        opened = sockets() - before
        assert {port for _, port, _ in opened} == {
            int(service.endpoints[0].rpartition(":")[2]),
            service.metrics_port,
        }
        assert all(ipaddress.ip_address(address).is_loopback for address, _, _ in opened)
        assert {state for _, _, state in opened} == {psutil.CONN_LISTEN}


def test_nothing_is_found_by_scouting_and_metrics_are_off() -> None:
    config = zenoh_config(ServiceConfig().network)
    for scouting in ("multicast", "gossip"):
        assert json.loads(config.get_json(f"scouting/{scouting}/enabled")) is False
    assert ServiceConfig().monitoring.metrics_port is None


def test_clients_look_on_loopback() -> None:
    assert DEFAULT_ENDPOINT == NetworkSettings().endpoints[0] == "tcp/127.0.0.1:7447"


def test_compose_publishes_on_loopback_alone() -> None:
    services = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]
    published = [port for service in services.values() for port in service.get("ports", [])]
    assert published
    assert all(port.startswith("127.0.0.1:") for port in published)
    assert not any("network_mode" in service for service in services.values())
