"""The Kubernetes example, checked against what it starts: options, ports, shards, names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from koop_service.serving.config import ServiceConfig
from koop_service.serving.options import read_options
from koop_service.serving.sharding.ownership import EVERY_SHARD

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS: list[dict[str, Any]] = list(
    yaml.safe_load_all((ROOT / "deploy" / "kubernetes" / "koop.yaml").read_text())
)
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]


def document(kind: str, name: str) -> dict[str, Any]:
    (found,) = [d for d in DOCUMENTS if (d["kind"], d["metadata"]["name"]) == (kind, name)]
    return found


def container(workload: dict[str, Any]) -> dict[str, Any]:
    (only,) = workload["spec"]["template"]["spec"]["containers"]
    return only


ROUTER, WORKERS = document("Deployment", "koop-router"), document("StatefulSet", "koop-worker")


@pytest.fixture
def config_of(monkeypatch: pytest.MonkeyPatch):
    """The settings that pod `number` gets from its arguments."""
    variables = {e["name"]: e.get("value", "") for e in container(WORKERS)["env"]}
    variables["KOOP_STATE"] = "postgresql://koop@postgres/koop"  # from the secret

    def settings(number: int) -> ServiceConfig:
        monkeypatch.setattr("socket.gethostname", lambda: f"koop-worker-{number}")
        words = [
            re.sub(r"\$\((\w+)\)", lambda match: variables[match[1]], word)
            for word in container(WORKERS)["args"]
        ]
        return read_options(words)

    return settings


def test_the_pods_share_all_shards_without_overlap(config_of) -> None:
    count = WORKERS["spec"]["replicas"]
    owned = [config_of(number).placement.ownership().shards for number in range(count)]
    assert frozenset().union(*owned) == EVERY_SHARD
    assert sum(map(len, owned)) == len(EVERY_SHARD)


def test_the_options_reach_the_router_the_database_and_the_probes(config_of) -> None:
    config = config_of(0)
    (port,) = document("Service", "koop-router")["spec"]["ports"]
    assert config.network.connect == (f"tcp/koop-router:{port['port']}",)
    assert config.network.endpoints == ()
    assert config.state_store == "postgresql://koop@postgres/koop"
    (metrics,) = container(WORKERS)["ports"]
    assert config.monitoring.metrics_port == metrics["containerPort"]
    assert config.monitoring.metrics_address == "0.0.0.0"


def test_the_url_and_the_password_come_from_a_secret() -> None:
    secrets = {
        e["name"]: e["valueFrom"]["secretKeyRef"]
        for e in container(WORKERS)["env"]
        if "valueFrom" in e
    }
    assert secrets == {
        "KOOP_STATE": {"name": "koop-postgres", "key": "url"},
        "PGPASSWORD": {"name": "koop-postgres", "key": "password"},
    }


@pytest.mark.parametrize("workload", [ROUTER, WORKERS], ids=["router", "workers"])
def test_selectors_and_probes_refer_to_what_is_there(workload: dict[str, Any]) -> None:
    spec = workload["spec"]
    labels = spec["template"]["metadata"]["labels"]
    assert spec["selector"]["matchLabels"].items() <= labels.items()
    service = document("Service", workload["metadata"]["name"])["spec"]
    assert service["selector"].items() <= labels.items()
    ports = {port["name"] for port in container(workload)["ports"]}
    assert {port["targetPort"] for port in service["ports"]} <= ports
    for probe in ("readinessProbe", "livenessProbe"):
        (action,) = [v for v in container(workload)[probe].values() if isinstance(v, dict)]
        assert action["port"] in ports


def test_it_fits_the_images_of_this_repository() -> None:
    assert container(WORKERS)["image"] == COMPOSE["serve"]["image"]
    assert container(ROUTER)["image"] == COMPOSE["router"]["image"]
    assert container(ROUTER)["args"] == COMPOSE["router"]["command"]
    assert WORKERS["spec"]["serviceName"] == "koop-worker"
    assert document("Service", "koop-worker")["spec"]["clusterIP"] == "None"
    user = WORKERS["spec"]["template"]["spec"]["securityContext"]["runAsUser"]
    assert f"useradd --uid {user}" in (ROOT / "Dockerfile").read_text()
