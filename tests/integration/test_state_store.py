"""The service with its states in PostgreSQL: they move to another machine, and outages pass."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from integration.loopback import Loop, Source, config_for, loop, wait_until
from integration.postgres_server import PostgresServer, postgres_server

from koop_service.serving.config import ComputeSettings, DurabilitySettings, ServiceConfig


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    with postgres_server() as server:
        yield server


def settings(folder: Path, model: Path, url: str) -> ServiceConfig:
    return replace(
        config_for(folder, model),
        compute=ComputeSettings(batch=4),
        durability=DurabilitySettings(snapshot_every=0.1),
        state_store=url,
    )


def is_durable(koop: Loop) -> bool:
    metrics = koop.service.metrics
    return metrics.value("koop_not_durable") == 0 and metrics.value("koop_snapshots_total") > 0


def test_another_machine_continues_where_the_first_one_was(
    server: PostgresServer, tmp_path: Path, model: Path
) -> None:
    url = server.new_schema("moved")
    with loop(settings(tmp_path / "one", model, url)) as koop:
        Source(koop.session, "cart/0").stream(40)
        first = koop.predict("cart/0")
    with loop(settings(tmp_path / "two", model, url)) as koop:
        assert koop.service.restored == 1
        np.testing.assert_array_equal(koop.predict("cart/0").codes, first.codes)


def test_while_the_database_is_away_the_service_goes_on_and_says_so(
    server: PostgresServer, tmp_path: Path, model: Path
) -> None:
    with loop(settings(tmp_path, model, server.new_schema("away"))) as koop:
        source = Source(koop.session, "cart/0")
        source.stream(40)
        wait_until(lambda: is_durable(koop), "the first snapshot")
        server.kill()
        source.stream(50, start=40)
        assert koop.state("cart/0").frames == 50
        wait_until(lambda: koop.service.metrics.value("koop_not_durable") == 1, "the complaint")
        server.start()
        source.stream(60, start=50)
        wait_until(lambda: is_durable(koop), "the database's return")
        assert koop.state("cart/0").frames == 60


def test_it_waits_for_the_database_at_its_start(
    server: PostgresServer, tmp_path: Path, model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = settings(tmp_path, model, server.new_schema("late"))
    server.kill()
    began = threading.Event()

    def serve() -> None:
        with loop(config):
            began.set()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        wait_until(lambda: "waiting for it" in caplog.text, "the wait")
        assert not began.is_set()
    finally:
        server.start()
        thread.join()
    assert began.is_set()
    assert "the state in the database" in caplog.text


def test_who_lost_its_shards_stops(server: PostgresServer, tmp_path: Path, model: Path) -> None:
    url = server.new_schema("fenced")
    with loop(settings(tmp_path / "former", model, url)) as former:
        source = Source(former.session, "cart/0")
        source.stream(40)
        wait_until(lambda: is_durable(former), "the first snapshot")
        with loop(settings(tmp_path / "newer", model, url)) as newer:
            assert newer.service.restored == 1
            source.stream(41, start=40)
            wait_until(lambda: former.service.keeper.is_fenced, "the fence")
