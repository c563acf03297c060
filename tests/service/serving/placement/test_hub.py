"""The hub in front of several workers."""

from __future__ import annotations

from pathlib import Path

import pytest

from koop_service.serving.config import NetworkSettings
from koop_service.serving.placement.hub import hub

RULES = """{access_control: {enabled: true, default_permission: "deny", rules: [], subjects: [],
policies: []}}"""


def test_access_rules_that_would_keep_workers_out_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(RULES)
    settings = NetworkSettings(listen=("tcp/127.0.0.1:0",), zenoh_config=file)
    with pytest.raises(ValueError, match="access rules"), hub(settings):
        pass


def test_workers_of_others_routers_use_the_settings_as_they_are() -> None:
    settings = NetworkSettings(connect=("tcp/router:7447",))
    with hub(settings) as shared:
        assert (shared.endpoints, shared.network) == ([], settings)
