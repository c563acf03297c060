"""Who answers the simulator: a koop-serve of its own, or the baseline in its place, on loopback."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import zenoh

from koop_service.encoding.weights import load_card
from koop_service.evaluation.control.learned_control import serving
from koop_service.evaluation.control.plants import Plant
from koop_service.evaluation.programs import find_program
from koop_service.evaluation.trained import baseline_path, weights_path


@contextmanager
def koop_serve(plant: Plant, weights: Path) -> Iterator[str]:
    """A koop-serve process with the plant's model; its endpoint."""
    endpoint = free_endpoint()
    model = f"{plant.name}/*={weights_path(weights, plant.system)}"
    with tempfile.TemporaryDirectory() as state:
        command = [find_program("koop-serve"), "--models", model, "--listen", endpoint]
        process = subprocess.Popen(
            [*command, "--state-folder", state, "--log-level", "warning"],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        try:
            _await_greeting(process)
            yield endpoint
        finally:
            process.terminate()
            process.wait()


@contextmanager
def learned_b(plant: Plant, weights: Path) -> Iterator[str]:
    """The baseline of [6] for the plant, with our model's estimator settings; its endpoint.

    Where ours is centred on a learned mean, rho is the baseline's own: it has no such mean.
    """
    endpoint = free_endpoint()
    config = zenoh.Config()
    for key, value in (
        ("mode", "peer"),
        ("listen/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
        ("scouting/gossip/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    path = baseline_path(weights, plant.system)
    card, estimator = load_card(path), load_card(weights_path(weights, plant.system)).estimator
    if estimator.prior_mean:
        estimator = replace(card.estimator, forgetting=estimator.forgetting)
    settings = estimator.settings(card.code_size, control_size=1)
    with zenoh.open(config) as session, serving(session, path, settings):
        yield endpoint


def free_endpoint() -> str:
    """A loopback endpoint that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return f"tcp/127.0.0.1:{taken.getsockname()[1]}"


def _await_greeting(process: subprocess.Popen[str]) -> None:
    if process.stdout is None or "ready" not in process.stdout.readline():
        process.wait()
        raise ValueError(f"koop-serve ended with exit code {process.returncode}; see above")
