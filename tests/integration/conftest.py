"""Fixtures: an untrained model, and a fresh service with a client for each test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from integration.loopback import Loop, Source, config_for, loop, write_model
from integration.secured import FRAMES, OTHER, ROBOT, Secured, deploy, secured, stream


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model"))


@pytest.fixture
def koop(tmp_path: Path, model: Path) -> Iterator[Loop]:
    with loop(config_for(tmp_path, model)) as running:
        yield running


@pytest.fixture
def cart(koop: Loop) -> Source:
    """A trajectory past its warm-up, for whoever asks: no other session can overtake its frames."""
    source = Source(koop.session, "cart/0")
    source.stream(40)
    assert koop.state("cart/0").next_seq == 40
    return source


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory, model: Path) -> Iterator[Secured]:
    """A service behind the shipped TLS and access rules, one for all tests of a module."""
    folder = tmp_path_factory.mktemp("guarded")
    with secured(deploy(folder / "pki"), folder / "state", model) as running:
        yield running


@pytest.fixture(scope="module")
def streamed(guarded: Secured) -> None:
    """Two robots have streamed, each with its own certificate."""
    for certificate, name in (("robot7", ROBOT), ("robot8", OTHER)):
        with guarded.session(certificate) as session:
            stream(session, name, FRAMES)
