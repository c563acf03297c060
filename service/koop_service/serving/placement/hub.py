"""The hub of several workers: a Zenoh router outside of them, so that none takes it along."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from koop_service.serving.config import NetworkSettings
from koop_service.serving.session import listens, locators, open_session

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

    Workers reach it by a socket in a folder that only this user can enter, also past access rules.
    Raises what `open_session` does.
    """
    if not listens(settings):
        yield Hub([], settings)
        return
    with tempfile.TemporaryDirectory(prefix="koop-") as folder:
        private = f"unixsock-stream/{folder}/hub"
        with open_session(settings, _PATIENCE, private) as session:
            public = [where for where in locators(session) if not where.startswith("unixsock")]
            yield Hub(
                public, NetworkSettings(connect=(private,), shared_memory=settings.shared_memory)
            )
