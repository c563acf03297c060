"""The hub in front of several workers."""

from __future__ import annotations

from pathlib import Path

from koop_service.serving.config import NetworkSettings
from koop_service.serving.placement.hub import hub
from koop_service.serving.session import open_session

RULES = """{mode: "router", access_control: {enabled: true, default_permission: "deny", rules: [],
subjects: [], policies: []}}"""


def test_workers_come_past_access_rules_that_keep_all_others_out(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(RULES)
    listening = NetworkSettings(listen=("tcp/127.0.0.1:0",), zenoh_config=file)
    with hub(listening) as shared, open_session(shared.network) as worker:
        other = worker.declare_subscriber("koop/frame/**")
        outside = NetworkSettings(connect=(shared.endpoints[0],))
        with open_session(shared.network) as second, open_session(outside) as stranger:
            stranger.put("koop/frame/00/cart", b"a stranger's")
            second.put("koop/frame/00/cart", b"a worker's")
            assert other.recv().payload.to_bytes() == b"a worker's"


def test_a_zenoh_file_that_listens_is_a_hub(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text('{mode: "router", listen: {endpoints: ["tcp/127.0.0.1:0"]}}')
    with hub(NetworkSettings(zenoh_config=file)) as shared:
        assert shared.endpoints[0].startswith("tcp/127.0.0.1:")
        assert shared.network.connect[0].startswith("unixsock-stream/")
    file.write_text('{mode: "client", connect: {endpoints: ["tcp/router:7447"]}}')
    settings = NetworkSettings(zenoh_config=file)
    with hub(settings) as shared:
        assert (shared.endpoints, shared.network) == ([], settings)


def test_workers_of_others_routers_use_the_settings_as_they_are() -> None:
    settings = NetworkSettings(connect=("tcp/router:7447",))
    with hub(settings) as shared:
        assert (shared.endpoints, shared.network) == ([], settings)
