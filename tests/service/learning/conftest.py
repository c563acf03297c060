"""Recordings that the tests train on."""

from __future__ import annotations

from pathlib import Path

import pytest

from koop_service.learning.recording import Recording, load_recording

from .blobs import moving_blobs, pushes, write


@pytest.fixture(scope="session")
def recording_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three actuated trajectories."""
    frames = moving_blobs()
    return write(tmp_path_factory.mktemp("data") / "blobs.h5", frames, pushes(frames))


@pytest.fixture(scope="session")
def recording(recording_file: Path) -> Recording:
    return load_recording(recording_file)


@pytest.fixture(scope="session")
def free_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three trajectories without controls."""
    frames = moving_blobs()
    return write(tmp_path_factory.mktemp("data") / "free.h5", frames, pushes(frames, 0))
