"""Test sets made once by koop-dataset itself, and weights that were never trained."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.weights import EstimatorDefaults, ModelCard, save_weights
from koop_service.evaluation import systems
from koop_service.evaluation.datasets import TestSet, test_set
from koop_service.evaluation.systems import System

TRAJECTORIES, SEED = 2, 1000
SMALL = dataclasses.replace(systems.SYSTEMS["pendulum-low"], fit_frames=30, frames=70)


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of test sets."""
    return tmp_path_factory.mktemp("test-sets")


@pytest.fixture(scope="session")
def small_set(data: Path) -> TestSet:
    """Two pendulums of 70 frames."""
    return test_set(SMALL, TRAJECTORIES, SEED, data)


@pytest.fixture
def small_system(monkeypatch: pytest.MonkeyPatch) -> System:
    """pendulum-low as `small_set` has it, in the table."""
    monkeypatch.setitem(systems.SYSTEMS, "pendulum-low", SMALL)
    return SMALL


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """A folder with a model for pendulum-low, without its baseline."""
    folder = tmp_path / "weights"
    (folder / "baselines").mkdir(parents=True)
    save_weights(folder / "pendulum-low.safetensors", initialised(8, 0), card())
    return folder


@pytest.fixture
def weights_with_baseline(weights: Path) -> Path:
    """The same, with a learned A that repeats the last code."""
    Theta = torch.cat([torch.zeros(8, 8), torch.eye(8), torch.zeros(8, 1)], dim=1)
    path = weights / "baselines" / "pendulum-low-learned-A.safetensors"
    save_weights(path, initialised(8, 0), card(dynamics="learned-A"), Theta)
    return weights


def card(renderer: str = "koop-sdf-1", dynamics: str = "fitted") -> ModelCard:
    """A card that fits what koop-dataset draws."""
    training = {"frames": 100, "trajectories": 7, "command": "koop-train x"}
    estimator = EstimatorDefaults(rho=1e-4)
    return ModelCard(
        "pendulum", renderer, 0.05, estimator=estimator, training=training, dynamics=dynamics
    )
