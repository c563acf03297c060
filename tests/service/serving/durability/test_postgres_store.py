"""The PostgreSQL store: the contract, several owners at once, and a server that goes away."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from contextlib import closing

import psycopg
import pytest
from integration.postgres_server import PostgresServer, postgres_server

from koop_service.serving.durability.postgres_store import PostgresStore
from koop_service.serving.durability.store import AwayError, FencedError, StoreError
from koop_service.serving.sharding.ownership import EVERY_SHARD

from .store_contract import StoreContract, name_of

_NUMBERS = itertools.count()


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    with postgres_server() as server:
        yield server


@pytest.fixture
def url(server: PostgresServer) -> str:
    return server.new_schema(f"test_{next(_NUMBERS)}")


class TestPostgresStore(StoreContract):
    """The contract."""

    @pytest.fixture
    def store(self, url: str):
        with closing(PostgresStore(url)) as store:
            yield store


def test_two_owners_that_claim_at_once_get_different_epochs(url: str) -> None:
    """And the tables are made once, though all want to."""
    claims = []

    def claim(number: int) -> None:
        with closing(PostgresStore(url)) as store:
            claims.append(store.claim(f"owner {number}", EVERY_SHARD))

    threads = [threading.Thread(target=claim, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(claim.epoch for claim in claims) == [1, 2, 3, 4, 5, 6]


def test_a_batch_is_over_before_a_claim_or_it_is_refused(url: str) -> None:
    """A writer and its successor at once: what the successor loads is what stays."""
    name, saved = name_of("00"), []
    with closing(PostgresStore(url)) as first, closing(PostgresStore(url)) as second:
        claim = first.claim("first", EVERY_SHARD)

        def write() -> None:
            for number in itertools.count():
                try:
                    first.save(claim, {name: b"%d" % number})
                except FencedError:
                    return
                saved.append(b"%d" % number)

        writer = threading.Thread(target=write)
        writer.start()
        while len(saved) < 20 and writer.is_alive():
            time.sleep(0.001)
        second.claim("second", {"00"})
        loaded = second.load({"00"})
        writer.join()
        assert second.load({"00"}) == loaded == {name: saved[-1]}


def test_tables_of_before_there_were_dates_get_them(url: str) -> None:
    with closing(PostgresStore(url)) as store:
        store.save(store.claim("me", EVERY_SHARD), {"a": b"1"})
    with psycopg.connect(url) as connection:
        connection.execute("ALTER TABLE koop_records_1 DROP COLUMN saved_at")
    with closing(PostgresStore(url)) as store:
        assert store.load(EVERY_SHARD) == {"a": b"1"}
        assert (store.silent(EVERY_SHARD, 60.0), store.silent(EVERY_SHARD, 0.0)) == ([], ["a"])


def test_a_server_that_goes_away_is_told_and_found_again() -> None:
    now = [0.0]
    with (
        postgres_server() as server,
        closing(PostgresStore(server.url(), lambda: now[0])) as store,
    ):
        claim = store.claim("me", EVERY_SHARD)
        store.save(claim, {"a": b"1"})
        server.kill()
        for wait in (0.5, 1.0, 2.0):
            with pytest.raises(AwayError, match="postgres on"):
                store.save(claim, {"a": b"2"})
            with pytest.raises(AwayError):
                store.save(claim, {"a": b"2"})
            now[0] += wait  # it asks again after at most so long
        server.start()
        store.save(claim, {"a": b"3"})
        assert store.load(EVERY_SHARD) == {"a": b"3"}


def test_refusals_are_explained_without_the_password(server: PostgresServer) -> None:
    refused = PostgresStore(f"{server.url()}&dbname=nowhere&password=secret")
    with pytest.raises(StoreError, match=r'"nowhere" does not exist') as told:
        refused.load(EVERY_SHARD)
    assert "secret" not in str(told.value)
    with pytest.raises(ValueError, match="no PostgreSQL URL"):
        PostgresStore("postgresql://%zz/")
