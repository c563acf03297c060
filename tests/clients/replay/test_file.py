"""The log on disk: what was appended is there, in order, whoever was killed; and it stays small."""

from __future__ import annotations

import logging
import os
import resource
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from koop_clients.replay.file import CONTROL, FRAME, LogFile
from koop_protocol import MAX_BATCH, Durable, ReplayQuery

from .filled import LARGE, A, B, C, fill, read_all


@pytest.fixture
def file(tmp_path: Path):
    with closing(LogFile(tmp_path / "log", LARGE)) as opened:
        yield opened


@pytest.fixture
def hasty_threads():
    """They change as often as they can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@contextmanager
def full_disk() -> Iterator[None]:
    """No file of this process takes anything."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_what_was_put_comes_back_in_order_and_by_trajectory(file: LogFile) -> None:
    one, other = fill(file, "a", A, 100), fill(file, "b", A, 3)
    one += fill(file, "a", B, 2)
    assert read_all(file, "a") == one
    assert read_all(file, "b") == other
    reply = file.read("a", ReplayQuery())
    assert (len(reply.messages), reply.end) == (MAX_BATCH, False)
    assert (reply.first_epoch, reply.first_seq, reply.last_epoch, reply.last_seq) == (A, 0, B, 1)
    assert file.trajectories == ["a", "b"]
    assert file.bytes == sum(map(len, one + other))


@pytest.mark.parametrize(
    ("query", "first"),
    [
        (ReplayQuery(A, 7), 14),
        (ReplayQuery(B, 0), 20),
        (ReplayQuery(A, 10), 20),  # ahead of what the log has of this epoch: the next one
        (ReplayQuery(C, 5), 0),  # unknown: all there is
        (ReplayQuery(), 0),
    ],
)
def test_a_replay_begins_where_it_was_asked_for(
    file: LogFile, query: ReplayQuery, first: int
) -> None:
    messages = fill(file, "a", A, 10) + fill(file, "a", B, 5)
    assert read_all(file, "a", query) == messages[first:]


def test_a_trajectory_without_messages_has_an_empty_log(file: LogFile) -> None:
    reply = file.read("nobody", ReplayQuery())
    assert (reply.messages, reply.end, reply.last_epoch) == ((), True, None)


def test_a_batch_is_bounded_in_bytes_and_what_is_larger_comes_alone(file: LogFile) -> None:
    for seq, size in enumerate((40, 40, 500, 40)):
        file.append("a", A, seq, FRAME, bytes(size))
    query, batches, end = ReplayQuery(max_bytes=100), [], False
    while not end:
        reply = file.read("a", query)
        batches.append([len(message) for message in reply.messages])
        query, end = replace(query, after=reply.position), reply.end
    assert batches == [[40, 40], [500], [40]]


def test_what_is_too_large_for_who_asks_is_passed_over(file: LogFile) -> None:
    for seq, size in enumerate((40, 501, 40, 501)):
        file.append("a", A, seq, FRAME, bytes(size))
    reply = file.read("a", ReplayQuery(max_message_bytes=500))
    assert ([len(message) for message in reply.messages], reply.end) == ([40, 40], True)
    assert file.read("a", ReplayQuery(after=reply.position)).messages == ()


def test_what_is_durable_is_forgotten_with_all_epochs_before(file: LogFile) -> None:
    fill(file, "a", A, 200)
    fill(file, "b", A, 2)
    messages = fill(file, "a", B, 200)
    assert file.forget([Durable("a", B, 150)]) == 400 + 300
    assert read_all(file, "a") == messages[300:]
    assert file.forget([Durable("a", A, 199)]) == 0, "an epoch that is not there any more"
    assert file.forget([Durable("a", C, 3)]) == 0, "somebody else's epoch"
    assert len(read_all(file, "b")) == 4
    assert file.bytes == sum(map(len, messages[300:] + read_all(file, "b")))


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_it_is_lists_that_forget_their_heads(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Any appends, acknowledgements, restarts and questions, against plain lists."""
    path = tmp_path_factory.mktemp("log") / "log"
    file = LogFile(path, LARGE)
    kept: dict[str, list[tuple[str, int, bytes]]] = {"a": [], "b": []}
    epochs, seq, position = [A], 0, None
    for number in range(data.draw(st.integers(1, 30))):
        what = data.draw(st.sampled_from(["append"] * 5 + ["epoch", "forget", "reopen", "read"]))
        name = data.draw(st.sampled_from("ab"))
        if what == "append":
            message = f"{number}".encode()
            file.append(name, epochs[-1], seq, FRAME, message)
            kept[name].append((epochs[-1], seq, message))
            seq += 1
        elif what == "epoch":
            epochs, seq = [*epochs, f"{number:016x}"], 0
        elif what == "forget":
            durable = []
            for one in filter(kept.get, "ba"):
                at = data.draw(st.integers(0, len(kept[one]) - 1))
                durable.append(Durable(one, *kept[one][at][:2]))
                kept[one] = kept[one][at:]
            file.forget(durable)
        elif what == "reopen":
            file.close()
            file = LogFile(path, LARGE)
        elif kept[name]:
            at = data.draw(st.integers(0, len(kept[name]) - 1))
            query = ReplayQuery(*kept[name][at][:2])
            assert read_all(file, name, query) == [k[2] for k in kept[name][at:]]
        replies = {one: file.read(one, ReplayQuery()) for one in kept}
        for one, reply in replies.items():
            assert [k[2] for k in kept[one]] == list(reply.messages)
        reached = max(reply.position for reply in replies.values())
        assert position is None or reached >= position, "a position was used twice"
        position = reached if any(kept.values()) else position
    file.close()


def test_the_oldest_are_dropped_when_it_is_full_and_that_is_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(LogFile(tmp_path / "log", 10_000)) as file:
        messages = fill(file, "a", A, 5, 100)
        with caplog.at_level(logging.WARNING):
            messages += fill(file, "b", A, 100, 100)
        assert file.bytes <= 10_000
        kept = read_all(file, "a") + read_all(file, "b")
        assert kept == messages[-len(kept) :]
        assert len(kept) > 80
        counted = [file.read(name, ReplayQuery()).dropped for name in ("a", "b")]
        assert (counted[0], sum(counted)) == (10, len(messages) - len(kept))
    assert "is full" in caplog.text
    with closing(LogFile(tmp_path / "log", 10_000)) as file:
        assert file.read("a", ReplayQuery()).dropped == 10


def test_a_message_larger_than_the_log_is_kept_alone(tmp_path: Path) -> None:
    with closing(LogFile(tmp_path / "log", 1000)) as file:
        fill(file, "a", A, 3, 100)
        file.append("a", A, 3, FRAME, bytes(5000))
        assert read_all(file, "a") == [bytes(5000)]
    with closing(LogFile(tmp_path / "other", 1000)) as file:
        file.append("a", A, 0, FRAME, bytes(5000))
        assert read_all(file, "a") == [bytes(5000)]


def test_the_tail_is_the_newest_frame(file: LogFile) -> None:
    assert file.tail("a") is None
    file.append("a", A, 0, FRAME, b"0")
    tail = file.tail("a")
    assert tail is not None
    assert (tail.epoch, tail.seq, tail.data, tail.controlled) == (A, 0, b"0", False)
    file.append("a", A, 0, CONTROL, b"u")
    tail = file.tail("a")
    assert tail is not None
    assert (tail.data, tail.controlled) == (b"0", True)
    file.forget([Durable("a", A, 0)])
    assert file.tail("a") == tail


def test_what_a_full_disk_does_not_take_changes_nothing(tmp_path: Path) -> None:
    with closing(LogFile(tmp_path / "log", 10_000)) as file:
        messages = fill(file, "a", A, 40, 100)
        held, reply = file.bytes, file.read("a", ReplayQuery())
        with full_disk():
            for attempt in (
                lambda: file.append("a", A, 40, FRAME, b"one more"),
                lambda: file.append("new", A, 0, FRAME, b"one more"),
                lambda: file.append("a", A, 40, FRAME, bytes(5000)),  # which has to make room first
                lambda: file.forget([Durable("a", A, 30)]),
            ):
                with pytest.raises(sqlite3.Error):
                    attempt()
                assert (file.bytes, file.read("a", ReplayQuery())) == (held, reply)
        assert file.trajectories == ["a"]
        file.append("new", A, 0, FRAME, b"goes on")
        assert file.forget([Durable("a", A, 30)]) == 60
        assert read_all(file, "a") == messages[60:]
    with closing(LogFile(tmp_path / "log", 10_000)) as file:
        assert (read_all(file, "a"), read_all(file, "new")) == (messages[60:], [b"goes on"])


@pytest.mark.usefixtures("hasty_threads")
def test_whoever_reads_sees_one_moment_whatever_others_do(file: LogFile) -> None:
    """Every reply is the log of a moment: from its first message on, none is missing."""
    count, names = 1500, ["a", "b"]

    def put() -> None:
        for seq in range(count):
            for name in names:
                file.append(name, A, seq, FRAME, b"%d" % seq)
                file.append(name, A, seq, CONTROL, b"%d" % seq)

    def forget() -> None:
        while (last := file.read("b", ReplayQuery()).last_seq or 0) < count - 1:
            file.forget([Durable(name, A, max(0, last - 5)) for name in names])

    def read() -> int:
        seen = 0
        while seen < count - 1:
            reply = file.read("a", ReplayQuery(max_bytes=200))
            first, seen = reply.first_seq or 0, reply.last_seq or 0
            found = [int(data) for data in reply.messages]
            # The first control alone may be there: its frame is forgotten with what is before.
            assert found == [first + k // 2 for k in range(len(found))]
            assert not reply.end or not found or found[-1] == seen
            tail = file.tail("a")
            assert tail is None or int(tail.data) == tail.seq >= seen
        return seen

    with ThreadPoolExecutor(4) as pool:
        for work in [pool.submit(work) for work in (put, forget, forget, read)]:
            work.result()


def test_much_is_forgotten_in_parts_between_which_the_log_can_be_used(tmp_path: Path) -> None:
    kept, held = [], []
    with closing(LogFile(tmp_path / "log", LARGE)) as file:
        for seq in range(1500):
            for name in ("a", "b"):
                file.append(name, A, seq, FRAME, b"%d" % seq)
            kept.append(b"%d" % seq)

        def between() -> None:
            held.append(file.bytes)
            file.append("c", A, len(held), FRAME, b"meanwhile")

        durable = [Durable("a", A, 1300), Durable("b", A, 1200), Durable("a", A, 1400)]
        assert file.forget(durable, between) == 1400 + 1200
        assert held == sorted(held, reverse=True)
        assert len(held) > 1
    with closing(LogFile(tmp_path / "log", LARGE)) as file:
        assert [read_all(file, name) for name in ("a", "b")] == [kept[1400:], kept[1200:]]
        assert read_all(file, "c") == [b"meanwhile"] * len(held)


def test_tidying_keeps_everything_and_the_write_ahead_log_short(tmp_path: Path) -> None:
    with closing(LogFile(tmp_path / "log", LARGE)) as file:
        for seq in range(30):
            file.append("a", A, seq, FRAME, bytes([seq]) * (2 << 20))
            if seq % 5 == 4:
                file.tidy()
        assert (tmp_path / "log-wal").stat().st_size < 48 << 20
        messages = read_all(file, "a", ReplayQuery(max_bytes=4 << 20))
        assert [message[0] for message in messages] == list(range(30))


def test_a_write_ahead_log_that_grew_long_does_not_stay_so(tmp_path: Path) -> None:
    with closing(LogFile(tmp_path / "log", LARGE)) as file:
        for seq in range(40):
            file.append("a", A, seq, FRAME, bytes(2 << 20))
        assert (tmp_path / "log-wal").stat().st_size > 80 << 20
        file.tidy()
        file.append("a", A, 40, FRAME, b"begins anew")
        assert (tmp_path / "log-wal").stat().st_size <= 64 << 20
        assert file.read("a", ReplayQuery(A, 40)).messages == (b"begins anew",)


WRITER = """
import sys
from pathlib import Path
from koop_clients.replay.file import FRAME, LogFile
file = LogFile(Path(sys.argv[1]), 1 << 30)
for seq in range(10**6):
    file.append("a", "0" * 16, seq, FRAME, seq.to_bytes(4, "big") * 1000)
    if seq % 100 == 0:
        file.tidy()
        print(seq, flush=True)
"""


def test_what_was_appended_outlives_a_kill_at_any_moment(tmp_path: Path) -> None:
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", WRITER, str(tmp_path / "log")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=places) as writer:
        assert writer.stdout is not None
        said = [writer.stdout.readline() for _ in range(4)]
        writer.send_signal(signal.SIGKILL)
        last = int((said + writer.stdout.readlines())[-1])
    with closing(LogFile(tmp_path / "log", LARGE)) as file:
        found = read_all(file, "a", ReplayQuery(max_bytes=4 << 20))
    assert [int.from_bytes(m[:4], "big") for m in found] == list(range(len(found)))
    assert len(found) > last
    assert all(m == m[:4] * 1000 for m in found)
