"""The LMDB file: it keeps what it acknowledged, grows, and is never trusted when damaged."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import lmdb
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.durability.store import StoreError
from koop_service.serving.sharding.ownership import EVERY_SHARD
from koop_service.serving.trajectories.sealing import seal

from .store_contract import StoreContract

FILE = "estimators.lmdb"
SET = 2e9  # a time that only a clock that is set shows


class TestLmdbStore(StoreContract):
    """The contract."""

    @pytest.fixture
    def store(self, tmp_path: Path):
        with closing(LmdbStore(tmp_path / "new" / "folder")) as store:
            yield store


def stored(folder: Path, count: int) -> dict[str, bytes]:
    """As many records in a closed file."""
    records = {f"cart/{i}": seal({"number": i}) for i in range(count)}
    with closing(LmdbStore(folder)) as store:
        store.save(store.claim("me", EVERY_SHARD), records)
    return records


def loaded(folder: Path) -> dict[str, bytes]:
    with closing(LmdbStore(folder)) as store:
        return store.load(EVERY_SHARD)


def test_records_and_claims_outlive_the_process(tmp_path: Path) -> None:
    records = stored(tmp_path, 300)
    with closing(LmdbStore(tmp_path)) as store:
        assert store.load(EVERY_SHARD) == records
        assert store.claim("next", EVERY_SHARD).epoch == 2


def test_a_record_is_as_old_as_its_last_batch(tmp_path: Path) -> None:
    now = [SET]
    with closing(LmdbStore(tmp_path, lambda: now[0])) as store:
        claim = store.claim("me", EVERY_SHARD)
        store.save(claim, {"a": seal({"n": 1}), "b": seal({"n": 1})})
        now[0] += 60.0
        store.save(claim, {"b": seal({"n": 2})})
        assert store.silent(EVERY_SHARD, 60.0) == ["a"]
    with closing(LmdbStore(tmp_path, lambda: now[0] + 60.0)) as store:
        assert sorted(store.silent(EVERY_SHARD, 60.0)) == ["a", "b"]
        assert store.silent(EVERY_SHARD, 121.0) == []


def test_records_of_before_the_clock_was_set_are_young(tmp_path: Path) -> None:
    """A machine without a battery begins in 1970, and is set when it finds a server."""
    now = [30.0]
    with closing(LmdbStore(tmp_path, lambda: now[0])) as store:
        store.save(store.claim("me", EVERY_SHARD), {"a": seal({"n": 1})})
        now[0] = SET
        assert store.silent(EVERY_SHARD, 60.0) == []
        now[0] += 60.0
        assert store.silent(EVERY_SHARD, 60.0) == ["a"]


def test_records_of_before_there_were_dates_are_young(tmp_path: Path) -> None:
    stored(tmp_path, 3)
    with (
        lmdb.open(str(tmp_path / FILE), subdir=False, max_dbs=3) as environment,
        environment.begin(write=True) as transaction,
    ):
        transaction.drop(environment.open_db(b"times", transaction), delete=True)
    now = [SET]
    with closing(LmdbStore(tmp_path, lambda: now[0])) as store:
        assert len(store.load(EVERY_SHARD)) == 3
        assert store.silent(EVERY_SHARD, 60.0) == []
        now[0] += 60.0
        assert len(store.silent(EVERY_SHARD, 60.0)) == 3


def test_a_folder_that_cannot_be_made_is_explained(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match="--state-folder"):
        LmdbStore(tmp_path / "file" / "state")


WRITER = """
import sys
from pathlib import Path
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.sharding.ownership import EVERY_SHARD
from koop_service.serving.trajectories.sealing import seal
store = LmdbStore(Path(sys.argv[1]))
claim = store.claim("me", EVERY_SHARD)
for number in range(10**6):
    store.save(claim, {f"cart/{i}": seal({"number": number}) for i in range(20)})
    print(number, flush=True)
"""


def test_what_was_saved_outlives_a_kill_at_any_moment(tmp_path: Path) -> None:
    """A batch is there as a whole or not at all, and never missing once `save` has returned."""
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", WRITER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=places) as writer:
        assert writer.stdout is not None
        said = [writer.stdout.readline() for _ in range(7)]
        writer.send_signal(signal.SIGKILL)
        last = int((said + writer.stdout.readlines())[-1])
    records = loaded(tmp_path)
    found = set(records.values())
    assert len(records) == 20
    assert found in ({seal({"number": last})}, {seal({"number": last + 1})})


FULL = """
import resource, signal, sys
from pathlib import Path
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.durability.store import StoreError
from koop_service.serving.sharding.ownership import EVERY_SHARD
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
store = LmdbStore(Path(sys.argv[1]))
claim = store.claim("me", EVERY_SHARD)
store.save(claim, {"a": b"first"})
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, resource.RLIM_INFINITY))
try:
    store.save(claim, {"a": bytes(4 << 20)})
except StoreError as error:
    print(error)
print(store.load(EVERY_SHARD))
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
store.save(claim, {"a": b"second"})
print(store.load(EVERY_SHARD))
"""


def test_a_full_disk_is_told_and_gets_over(tmp_path: Path) -> None:
    """The kernel refuses to make the file larger, as it does on a full disk."""
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", FULL, str(tmp_path)]
    told = subprocess.run(command, capture_output=True, text=True, env=places, check=True).stdout
    why, before, after = told.splitlines()
    assert f"the state in {tmp_path / FILE} cannot be used" in why
    assert (before, after) == ("{'a': b'first'}", "{'a': b'second'}")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("sound")
    stored(folder, 200)
    return (folder / FILE).read_bytes()


@given(st.data())
@settings(max_examples=8, deadline=None)
def test_nothing_damaged_is_ever_loaded(
    sound: bytes, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Cut short, or with a page of it overwritten: LMDB itself crashes on some of these."""
    folder = tmp_path_factory.mktemp("damaged")
    page = data.draw(st.integers(0, len(sound) // 4096 - 1))
    damaged = sound[: 4096 * page + 11]
    if data.draw(st.booleans()):
        damaged = sound[: 4096 * page] + b"\xa5" * 4096 + sound[4096 * (page + 1) :]
    (folder / FILE).write_bytes(damaged)
    whole = {f"cart/{i}": seal({"number": i}) for i in range(200)}
    with closing(LmdbStore(folder)) as store:
        found = store.load(EVERY_SHARD)
        assert found in ({}, whole)
        if not found:
            (aside,) = folder.glob("*.unfit")
            assert aside.read_bytes() == damaged
            store.save(store.claim("me", EVERY_SHARD), whole)
            assert store.load(EVERY_SHARD) == whole


def test_a_file_of_another_version_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / FILE).write_bytes(b"something else" * 1000)
    with caplog.at_level(logging.WARNING):
        assert loaded(tmp_path) == {}
    assert "is left out" in caplog.text


SHARING = """
import sys
from pathlib import Path
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.trajectories.sealing import seal
from koop_service.serving.sharding.ownership import share
from koop_protocol import shard_of
number = int(sys.argv[2])
mine = share(number, 4)
store = LmdbStore(Path(sys.argv[1]))
claim = store.claim(f"worker {number}", mine)
for i in range(400):
    if shard_of(f"cart/{i}") in mine:
        store.save(claim, {f"cart/{i}": seal({"number": i, "load": bytes(100_000)})})
"""


def test_workers_that_begin_at_once_share_a_file_that_grows(tmp_path: Path) -> None:
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", SHARING, str(tmp_path)]
    workers = [subprocess.Popen([*command, str(number)], env=places) for number in range(4)]
    assert [worker.wait() for worker in workers] == [0] * 4
    records = loaded(tmp_path)
    assert records.keys() == {f"cart/{i}" for i in range(400)}
    assert not list(tmp_path.glob("*.unfit"))


def test_a_file_in_use_is_not_set_aside(tmp_path: Path) -> None:
    """Not even one that looks unfit: else its users would go on in a file that nobody reads."""
    program = SHARING.split("number =")[0] + "LmdbStore(Path(sys.argv[1]))"
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with closing(LmdbStore(tmp_path)) as store:
        with store._environment.begin(write=True) as transaction:
            transaction.put(b"format", b"another")
        subprocess.run([sys.executable, "-c", program, str(tmp_path)], env=places, check=True)
        assert not list(tmp_path.glob("*.unfit"))
