"""A Zenoh hub for each test, on a port of its own."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import pytest
import zenoh


@pytest.fixture
def hub() -> Iterator[zenoh.Session]:
    """A router session listening on loopback."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("adminspace/enabled", "true")
    with zenoh.open(config) as session:
        yield session


@pytest.fixture
def endpoint(hub: zenoh.Session) -> str:
    """Where the hub listens."""
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        for reply in hub.get(f"@/{hub.zid()}/router", timeout=1.0):
            if reply.ok is not None:
                locators = json.loads(reply.ok.payload.to_string())["locators"]
                if locators:
                    return str(locators[0])
    raise RuntimeError("the hub does not tell where it listens")
