"""A source with a log on real Zenoh: what it serves, what it forgets, and how it goes on."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zenoh

from koop_clients.connection import open_session
from koop_clients.replay.file import LogFile
from koop_clients.replay.log import SourceLog
from koop_clients.sources import FrameSource
from koop_protocol import (
    SOURCE_TOKENS,
    Control,
    Durable,
    ErrorReply,
    Frame,
    Message,
    ReplayQuery,
    ReplayReply,
    decode,
    durable_key,
    encode,
    replay_key,
    source_token,
)

IMAGE = np.arange(64 * 64, dtype=np.uint8).reshape(64, 64)


@pytest.fixture
def session(endpoint: str):
    with open_session(endpoint) as opened:
        yield opened


def ask(hub: zenoh.Session, name: str, payload: bytes | None) -> Message:
    """The answer of the log, once its token is there."""
    wait_until(lambda: source_token(name) in tokens(hub))
    (reply,) = hub.get(replay_key(name), payload=payload, timeout=10.0)
    return decode((reply.ok or reply.err).payload.to_bytes())


def replayed(hub: zenoh.Session, name: str, query: ReplayQuery | None = None) -> list[Message]:
    reply = ask(hub, name, None if query is None else encode(query))
    assert isinstance(reply, ReplayReply)
    return [decode(data) for data in reply.messages]


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def tokens(hub: zenoh.Session) -> set[str]:
    found = hub.liveliness().get(SOURCE_TOKENS, timeout=10.0)
    return {str(reply.ok.key_expr) for reply in found if reply.ok}


def test_what_was_put_is_served_with_the_same_bytes(
    hub: zenoh.Session, session: zenoh.Session, tmp_path: Path
) -> None:
    heard: list[bytes] = []
    subscribed = hub.declare_subscriber(
        "koop/*/26/line3/robot7", lambda s: heard.append(bytes(s.payload))
    )
    with (
        SourceLog(tmp_path / "log") as log,
        FrameSource(session, "line3/robot7", 1, log=log) as source,
    ):
        for k in range(3):
            source.put_frame(IMAGE)
            source.put_control([0.5 * k])
        messages = replayed(hub, "line3/robot7")
        assert [type(m) for m in messages] == [Frame, Control] * 3
        assert all(m.logged for m in messages if isinstance(m, Frame))
        wait_until(lambda: len(heard) == 6)
        assert {encode(m) for m in messages} == set(heard)
        later = replayed(hub, "line3/robot7", ReplayQuery(source.epoch, 2))
        assert [(type(m), m.seq) for m in later] == [(Frame, 2), (Control, 2)]
    subscribed.undeclare()


def test_a_token_says_whom_to_ask_as_long_as_it_can_be_asked(
    hub: zenoh.Session, session: zenoh.Session, tmp_path: Path
) -> None:
    with SourceLog(tmp_path / "log") as log:
        with FrameSource(session, "a/b", log=log) as source:
            source.put_frame(IMAGE)
            wait_until(lambda: tokens(hub) == {source_token("a/b")})
        assert tokens(hub) == {source_token("a/b")}, "the log outlives the source"
    wait_until(lambda: tokens(hub) == set())
    with FrameSource(session, "a/c") as plain:
        plain.put_frame(IMAGE)
        assert tokens(hub) == set()


def test_what_a_killed_source_left_is_served_before_any_new_frame(
    hub: zenoh.Session, session: zenoh.Session, tmp_path: Path
) -> None:
    with (
        SourceLog(tmp_path / "log") as log,
        FrameSource(session, "a", log=log) as former,
        FrameSource(session, "other", log=log) as other,
    ):
        former.put_frame(IMAGE)
        other.put_frame(IMAGE)
    with SourceLog(tmp_path / "log") as log:
        log.serve(session)
        wait_until(lambda: tokens(hub) == {source_token("a"), source_token("other")})
        with FrameSource(session, "a", log=log) as source:
            source.put_frame(IMAGE)
            found = [(m.epoch, m.seq) for m in replayed(hub, "a")]
    assert found == [(former.epoch, 0), (source.epoch, 0)]


def test_what_is_durable_is_forgotten(
    hub: zenoh.Session, session: zenoh.Session, tmp_path: Path
) -> None:
    with SourceLog(tmp_path / "log") as log, FrameSource(session, "a", log=log) as source:
        for _ in range(10):
            source.put_frame(IMAGE)
        before = log.bytes
        wait_until(lambda: tokens(hub) == {source_token("a")})
        # Neither nonsense nor what is meant for somebody else does anything.
        hub.put(durable_key("a"), b"nonsense")
        hub.put(durable_key("a"), encode(Durable("b", source.epoch, 9)))
        hub.put(durable_key("a"), encode(Durable("a", source.epoch, 7)))
        wait_until(lambda: log.bytes < before)
        assert [m.seq for m in replayed(hub, "a")] == [7, 8, 9]


def test_what_a_full_disk_did_not_let_it_forget_is_forgotten_later(
    hub: zenoh.Session, session: zenoh.Session, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with SourceLog(tmp_path / "log") as log, FrameSource(session, "a", log=log) as source:
        for _ in range(10):
            source.put_frame(IMAGE)
        held = log.bytes
        wait_until(lambda: tokens(hub) == {source_token("a")})
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))  # no file takes anything
        try:
            hub.put(durable_key("a"), encode(Durable("a", source.epoch, 7)))
            wait_until(lambda: "forgetting failed" in caplog.text)
            assert log.bytes == held
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        wait_until(lambda: log.bytes < held)
        assert [m.seq for m in replayed(hub, "a")] == [7, 8, 9]


def test_a_question_that_cannot_be_read_is_refused(
    hub: zenoh.Session, session: zenoh.Session, tmp_path: Path
) -> None:
    with SourceLog(tmp_path / "log") as log, FrameSource(session, "a", log=log) as source:
        source.put_frame(IMAGE)
        refusal = ask(hub, "a", b"nonsense")
        assert isinstance(refusal, ErrorReply)
        assert refusal.code == "malformed"


def test_an_epoch_goes_on_where_it_is_said_so(
    hub: zenoh.Session, session: zenoh.Session, tmp_path: Path
) -> None:
    with (
        SourceLog(tmp_path / "log") as log,
        FrameSource(session, "a", 1, log=log, resume=True) as former,
    ):
        assert (former.next_seq, former.awaits_control) == (0, False)
        former.put_frame(IMAGE)
        former.put_control([1.0])
        former.put_frame(IMAGE)
    with (
        SourceLog(tmp_path / "log") as log,
        FrameSource(session, "a", 1, log=log, resume=True) as source,
    ):
        assert (source.epoch, source.next_seq) == (former.epoch, 2)
        assert source.awaits_control
        source.put_control([2.0])
        assert source.put_frame(IMAGE) == 2
        with pytest.raises(ValueError, match="like the first one"):
            source.put_frame(IMAGE[:32])
        found = [(type(m), m.epoch, m.seq) for m in replayed(hub, "a")]
    epoch = former.epoch
    frames, controls = [(Frame, epoch, k) for k in range(3)], [(Control, epoch, k) for k in (0, 1)]
    assert found == [frames[0], controls[0], frames[1], controls[1], frames[2]]


def test_another_kind_of_stream_cannot_go_on(session: zenoh.Session, tmp_path: Path) -> None:
    with SourceLog(tmp_path / "log") as log:
        with FrameSource(session, "a", 1, log=log) as source:
            source.put_frame(IMAGE)
        with pytest.raises(ValueError, match="has control_size 1 and renderer ''; expected 2"):
            FrameSource(session, "a", 2, log=log, resume=True)
        with pytest.raises(ValueError, match="nothing to resume without a log"):
            FrameSource(session, "a", 1, resume=True)


def test_a_log_is_served_on_one_session(endpoint: str, session: zenoh.Session, tmp_path) -> None:
    with open_session(endpoint) as other, SourceLog(tmp_path / "log") as log:
        log.serve(session)
        with pytest.raises(ValueError, match="on another session already"):
            FrameSource(other, "a", log=log)


def test_a_frame_that_the_disk_does_not_take_is_put_and_does_not_claim_to_be_logged(
    hub: zenoh.Session, session: zenoh.Session, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    heard: list[Message] = []
    subscribed = hub.declare_subscriber(
        "koop/frame/**", lambda s: heard.append(decode(bytes(s.payload)))
    )
    log = SourceLog(tmp_path / "log")
    with FrameSource(session, "a", log=log) as source:
        source.put_frame(IMAGE)
        log.close()
        source.put_frame(IMAGE)
        wait_until(lambda: len(heard) == 2)
    assert [m.logged for m in heard if isinstance(m, Frame)] == [True, False]
    assert log.failures == 1
    assert "takes nothing at present" in caplog.text
    subscribed.undeclare()


def test_the_simulator_keeps_a_log(knowing, command, tmp_path: Path) -> None:
    path = tmp_path / "simulator.log"
    options = ("--system", "cartpole", "--duration", "1", "--trajectories", "2")
    service = knowing(*options)
    command(*options, "--log", str(path))
    with closing(LogFile(path, 1 << 30)) as file:
        logged = [decode(data) for data in file.read("cartpole/1", ReplayQuery()).messages]
        assert file.trajectories == ["cartpole/0", "cartpole/1"]
    put = [frame for frame in service.frames if frame.trajectory == "cartpole/1"]
    assert [encode(message) for message in logged] == [encode(frame) for frame in put]
    assert len(put) == 20
