"""Others on the network, in processes of their own, to be stopped or killed.

    python -m integration.bystander router ENDPOINT     # that a service and its sources connect to
    python -m integration.bystander reader ENDPOINT     # that subscribes to everything

Each prints a line when it is there, and stays until it is killed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from integration.loopback import client

from koop_service.serving.config import NetworkSettings
from koop_service.serving.session import open_session

_PATIENCE = 5_000_000
"""Zenoh's own, for whoever does not read [us]."""


def main(role: str, endpoint: str) -> None:
    router = NetworkSettings(listen=(endpoint,))
    with open_session(router, _PATIENCE) if role == "router" else client(endpoint) as session:
        if role == "reader":
            session.declare_subscriber("koop/**", lambda _: None)
        print("there", flush=True)
        threading.Event().wait()


@contextmanager
def bystander(role: str, endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """One that is there; it is killed at the end."""
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "integration.bystander", role, endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=places)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        yield process
    finally:
        process.kill()
        process.communicate()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
