"""The hub of several workers: a Zenoh router outside of them, so that none takes it along."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from koop_service.serving.config import NetworkSettings
from koop_service.serving.session import locators, open_session, zenoh_config

_PATIENCE = 5_000_000
"""How long a message waits for a slow reader before its link is closed [us]. More than a service
alone has: here the slow reader may be a worker under load."""


@dataclass(frozen=True)
class Hub:
    """Where clients connect to, and what the workers' own network settings are."""

    endpoints: list[str]
    network: NetworkSettings


@contextmanager
def hub(settings: NetworkSettings) -> Iterator[Hub]:
    """A router in this process, where the settings listen; else the workers join others' routers.

    Workers reach it by a socket in a folder that only this user can enter. Raises what
    `open_session` does, and ValueError where access rules would keep the workers out.
    """
    if not settings.endpoints:
        yield Hub([], settings)
        return
    if json.loads(zenoh_config(settings).get_json("access_control/enabled")):
        raise ValueError(
            f"{settings.zenoh_config} has access rules, which know nothing of workers without "
            "certificates; run a Zenoh router with this file, and workers that join it, with "
            "--workers N --connect"
        )
    with tempfile.TemporaryDirectory(prefix="koop-") as folder:
        private = f"unixsock-stream/{folder}/hub"
        listening = replace(settings, listen=(*settings.endpoints, private))
        with open_session(listening, _PATIENCE) as session:
            public = [where for where in locators(session) if not where.startswith("unixsock")]
            yield Hub(
                public, NetworkSettings(connect=(private,), shared_memory=settings.shared_memory)
            )
