"""Others on the network, in processes of their own, to be stopped or killed.

    python -m integration.bystander router ENDPOINT     # that a service and its sources connect to
    python -m integration.bystander reader ENDPOINT     # that subscribes to everything

Each prints a line when it is there, and stays until it is killed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh
from integration.loopback import client


def main(role: str, endpoint: str) -> None:
    with _router(endpoint) if role == "router" else client(endpoint) as session:
        if role == "reader":
            session.declare_subscriber("koop/**", lambda _: None)
        print("there", flush=True)
        threading.Event().wait()


def _router(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {
        "mode": "router",
        "listen/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


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
