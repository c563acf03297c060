"""Questions over real Zenoh, and every way in which an answer can fail to come."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import zenoh

from koop_clients.connection import open_session
from koop_clients.queries import NO_REPLY, KoopClient, KoopError
from koop_protocol import (
    EndReason,
    ErrorCode,
    ErrorReply,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    PredictQuery,
    PredictReply,
    ProtocolError,
    StateReply,
    decode,
    encode,
)

EPOCH = "0123456789abcdef"
Handler = Callable[[zenoh.Query], None]


@pytest.fixture
def koop(endpoint: str) -> Iterator[KoopClient]:
    with open_session(endpoint) as session:
        yield KoopClient(session, timeout=1.0)


@pytest.fixture
def serve(hub: zenoh.Session) -> Callable[[str, Handler], None]:
    declared = []

    def declare(key: str, handler: Handler) -> None:
        def answer(query: zenoh.Query) -> None:
            with query:
                handler(query)

        declared.append(hub.declare_queryable(key, answer))

    return declare


def prediction(name: str, horizon: int = 2) -> bytes:
    return encode(PredictReply(name, EPOCH, 7, codes=np.ones((horizon, 8))))


def test_a_prediction(koop: KoopClient, serve) -> None:
    asked: list[PredictQuery] = []

    def answer(query: zenoh.Query) -> None:
        message = decode(bytes(query.payload or b""))
        assert isinstance(message, PredictQuery)
        asked.append(message)
        query.reply(query.key_expr, prediction("a/b", message.horizon))

    serve("koop/predict/**", answer)
    reply = koop.predict("a/b", 3, [[1.0], [2.0], [3.0]], {"codes", "std"})
    assert (reply.trajectory, reply.seq) == ("a/b", 7)
    assert reply.codes is not None
    assert reply.codes.shape == (3, 8)
    assert asked[0].controls is not None
    assert asked[0].controls.tolist() == [[1.0], [2.0], [3.0]]
    assert asked[0].returns == {"codes", "std"}


def test_controls_to_a_target(koop: KoopClient, serve) -> None:
    def answer(query: zenoh.Query) -> None:
        message = decode(bytes(query.payload or b""))
        assert isinstance(message, LqrQuery)
        plan = np.full((message.horizon, 1), message.r)
        query.reply(query.key_expr, encode(LqrReply("a", EPOCH, 3, "solved", 1.0, 0.0, plan)))

    serve("koop/lqr/*", answer)
    reply = koop.lqr("a", LqrQuery(4, target_code=np.zeros(8), r=0.25))
    assert reply.controls is not None
    assert reply.controls.tolist() == [[0.25]] * 4


def test_a_task_and_its_end(koop: KoopClient, serve) -> None:
    asked: list[object] = []

    def answer(query: zenoh.Query) -> None:
        message = decode(bytes(query.payload or b""))
        asked.append(message)
        reply = LqrReply("a", EPOCH, 3, "solved", 1.0, 0.0, np.ones((4, 1)))
        end = LqrEnd("a", "me", EndReason.cancelled, "as asked")
        query.reply(query.key_expr, encode(reply if isinstance(message, LqrTask) else end))

    serve("koop/lqr/*", answer)
    task = LqrTask("me", LqrQuery(4, target_code=np.zeros(8)), seconds=5.0)
    assert koop.begin("a", task).controls is not None
    assert koop.cancel("a", "me") == LqrEnd("a", "me", EndReason.cancelled, "as asked")
    assert isinstance(asked[0], LqrTask)
    assert (asked[0].owner, asked[0].seconds) == ("me", 5.0)
    assert isinstance(asked[1], LqrCancel)


def test_the_state(koop: KoopClient, serve) -> None:
    state = StateReply("a", EPOCH, 5, "m", 8, 2, 1, 5, 2, 36, False, 0.0, 0.0, 0.0, {"gaps": 1})
    serve("koop/state/*", lambda query: query.reply(query.key_expr, encode(state)))
    assert koop.state("a") == state


def test_a_refusal_is_raised_with_its_parts(koop: KoopClient, serve) -> None:
    refusal = ErrorReply(
        ErrorCode.warming_up, "warming up, 12 of 36 frames", {"frames": 12, "warmup_frames": 36}
    )
    serve("koop/predict/*", lambda query: query.reply_err(encode(refusal)))
    with pytest.raises(KoopError) as caught:
        koop.predict("a", 2)
    assert caught.value.code == ErrorCode.warming_up
    assert str(caught.value) == "warming up, 12 of 36 frames"
    assert caught.value.details == {"frames": 12, "warmup_frames": 36}


def test_nobody_there_says_what_to_check(koop: KoopClient) -> None:
    with pytest.raises(KoopError, match="check that `koop-serve` runs") as caught:
        koop.predict("a", 2)
    assert caught.value.code == NO_REPLY


def test_silence_ends_with_the_timeout(koop: KoopClient, serve) -> None:
    serve("koop/predict/*", lambda _: time.sleep(1.0))
    started = time.monotonic()
    with pytest.raises(KoopError) as caught:
        koop.predict("a", 2, timeout=0.2)
    assert caught.value.code == NO_REPLY
    assert 0.15 < time.monotonic() - started < 0.8


def test_an_answer_wins_over_another_worker_s_refusal(koop: KoopClient, serve) -> None:
    refusal = encode(ErrorReply(ErrorCode.unknown_trajectory, "not mine"))
    serve("koop/predict/**", lambda query: query.reply_err(refusal))

    def later(query: zenoh.Query) -> None:
        time.sleep(0.1)
        query.reply(query.key_expr, prediction("a"))

    serve("koop/predict/*", later)
    assert koop.predict("a", 2).trajectory == "a"


@pytest.mark.parametrize("payload", [b"", b"hello", encode(ErrorReply("internal", "x"))])
def test_nonsense_is_named_so(koop: KoopClient, serve, payload: bytes) -> None:
    serve("koop/predict/*", lambda query: query.reply(query.key_expr, payload))
    with pytest.raises(KoopError, match="of the same version") as caught:
        koop.predict("a", 2)
    assert caught.value.code in (ErrorCode.malformed, ErrorCode.wrong_type)


def test_all_trajectories_at_once(koop: KoopClient, serve) -> None:
    def answer(query: zenoh.Query) -> None:
        for name in ("a", "b/c", "d"):
            query.reply(f"koop/predict/{name}", prediction(name))
        query.reply_err(encode(ErrorReply(ErrorCode.warming_up, "warming up")))

    serve("koop/predict/**", answer)
    found = koop.predict_all(2)
    assert sorted(found) == ["a", "b/c", "d"]
    assert all(found[name].trajectory == name for name in found)


def test_no_trajectory_at_all(koop: KoopClient, serve) -> None:
    with pytest.raises(KoopError) as caught:
        koop.predict_all(2)
    assert caught.value.code == NO_REPLY
    refusal = encode(ErrorReply(ErrorCode.warming_up, "warming up"))
    serve("koop/predict/**", lambda query: query.reply_err(refusal))
    with pytest.raises(KoopError) as caught:
        koop.predict_all(2)
    assert caught.value.code == ErrorCode.warming_up


def test_what_breaks_the_protocol_is_not_sent(koop: KoopClient) -> None:
    with pytest.raises(ProtocolError):
        koop.predict("a", 0)
    with pytest.raises(ProtocolError):
        koop.predict("a", 2, returns={"everything"})
    with pytest.raises(ProtocolError):
        koop.state("not a name")


def test_a_robot_needs_neither_torch_nor_a_simulator() -> None:
    code = (
        "import sys, koop_clients.sources, koop_clients.control, koop_clients.connection\n"
        "print({m.split('.')[0] for m in sys.modules})"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    for name in ("torch", "pinocchio", "numba", "tyro", "matplotlib", "h5py", "koop_service"):
        assert f"'{name}'" not in loaded
    assert "'zenoh'" in loaded
