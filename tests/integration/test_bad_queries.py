"""Queries that cannot be answered: each gets one clear error, and the service goes on."""

from __future__ import annotations

from pathlib import Path

import msgpack
import numpy as np
import pytest
from integration.loopback import DEADLINE, Loop, Source, config_for, loop, picture, wait_until

from koop_protocol import ErrorReply, LqrQuery, PredictQuery, PredictReply, StateReply, encode

QUERIES = {
    "horizon 0": ("bad_horizon", "koop/predict/cart/0?horizon=0"),
    "negative horizon": ("bad_horizon", "koop/predict/cart/0?horizon=-3"),
    "absurd horizon": ("bad_horizon", "koop/predict/cart/0?horizon=1000000"),
    "horizon in words": ("bad_horizon", "koop/predict/cart/0?horizon=ten"),
    "unknown part": ("malformed", "koop/predict/cart/0?return=prophecy"),
    "misspelt parameter": ("malformed", "koop/predict/cart/0?horizont=3"),
    "unknown trajectory": ("unknown_trajectory", "koop/predict/cart/none"),
    "unknown trajectory's state": ("unknown_trajectory", "koop/state/cart/none"),
    "no model": ("no_model", "koop/predict/crane/0"),
    "not a name": ("bad_key", "koop/predict/c~rt"),
    "nobody matches": ("unknown_trajectory", "koop/predict/crane/**"),
    "lqr without a query": ("malformed", "koop/lqr/cart/0"),
}

CODE = np.zeros(8)


def lqr(**changes: object) -> bytes:
    """An lqr_query with its map changed by hand."""
    fields = msgpack.unpackb(encode(LqrQuery(5, target_code=CODE, force=True)))
    return msgpack.packb({**fields, **changes})


def array(values: object) -> dict[str, object]:
    values = np.asarray(values)
    return {"dtype": values.dtype.str[1:], "shape": values.shape, "data": values.tobytes()}


PICTURE = {"target_code": None}

LQR_QUERIES = {
    "horizon 0": ("bad_horizon", {"horizon": 0}),
    "absurd horizon": ("bad_horizon", {"horizon": 100_000}),
    "a horizon too long to plan": ("bad_horizon", {"horizon": 900}),
    "no target": ("bad_target", {"target_code": None}),
    "code of a wrong size": ("bad_target", {"target_code": array(np.zeros(5))}),
    "a code beyond measure": ("bad_target", {"target_code": array(CODE + 1e200)}),
    "NaN code": ("not_finite", {"target_code": array(CODE * np.nan)}),
    "picture of a wrong shape": (
        "bad_target",
        {**PICTURE, "target_image": array(np.zeros((32, 32), np.uint8))},
    ),
    "picture of a wrong dtype": (
        "wrong_dtype",
        {**PICTURE, "target_image": array(np.zeros((64, 64)))},
    ),
    "picture out of range": (
        "bad_target",
        {**PICTURE, "target_image": array(np.full((64, 64), 7, np.float32))},
    ),
    "R zero": ("bad_weights", {"r": 0.0}),
    "R negative": ("bad_weights", {"r": -1.0}),
    "R not finite": ("not_finite", {"r": float("nan")}),
    "R of a wrong size": ("bad_weights", {"r": array(np.ones(2))}),
    "R not symmetric": ("bad_weights", {"r": array([[1.0, 2.0], [0.0, 1.0]])}),
    "Q negative": ("bad_weights", {"q": -1.0}),
    "Q of a wrong size": ("bad_weights", {"q": array(np.ones(3)), "target_code": array(CODE)}),
    "bounds crossed": (
        "bad_bounds",
        {"u_min": array(np.array([1.0])), "u_max": array(np.array([-1.0]))},
    ),
    "rates of a wrong size": ("bad_bounds", {"du_max": array(np.ones(2))}),
    "rates that force a change": ("bad_bounds", {"du_min": array(np.array([0.1]))}),
    "bounds that the rate does not reach": (
        "bad_bounds",
        {"u_min": array(np.array([5.0])), "du_max": array(np.array([0.1]))},
    ),
    "Qf of a wrong size": ("bad_weights", {"qf": array(np.ones(3))}),
    "Qf misspelt": ("malformed", {"qf": "ricatti"}),
    "a known channel that is not there": (
        "bad_controls",
        {"known_channels": [3], "known_controls": array(np.zeros((2, 1)))},
    ),
    "nothing left to decide": (
        "bad_controls",
        {"known_channels": [0], "known_controls": array(np.zeros((2, 1)))},
    ),
    "a gain with known channels": (
        "bad_controls",
        {"known_channels": [0], "known_controls": array(np.zeros((2, 1))), "method": "gain"},
    ),
    "an unknown method": ("malformed", {"method": "pid"}),
    "delay below 0": ("malformed", {"delay": -1}),
    "bounds of a wrong size": ("bad_bounds", {"u_max": array(np.ones(2))}),
    "from the future": ("unsupported_version", {"v": 9}),
    "a predict query": ("malformed", {"type": "predict_query"}),
}


def assert_still_serving(koop: Loop) -> None:
    assert isinstance(koop.predict("cart/0"), PredictReply)
    wait_until(lambda: koop.service.metrics.value("koop_queue_queries") == 0)


@pytest.mark.parametrize("case", QUERIES)
@pytest.mark.usefixtures("cart")
def test_a_bad_selector_gets_an_error(koop: Loop, case: str) -> None:
    code, selector = QUERIES[case]
    reply = koop.ask_one(selector)
    assert isinstance(reply, ErrorReply)
    assert reply.code == code
    assert len(reply.message) > 10
    assert koop.service.metrics.value("koop_refused_total", code=code) == 1
    assert_still_serving(koop)


@pytest.mark.parametrize("case", LQR_QUERIES)
@pytest.mark.usefixtures("cart")
def test_a_bad_lqr_query_gets_an_error(koop: Loop, case: str) -> None:
    code, changes = LQR_QUERIES[case]
    reply = koop.ask_one("koop/lqr/cart/0", lqr(**changes))
    assert isinstance(reply, ErrorReply)
    assert reply.code == code, reply.message
    assert_still_serving(koop)


@pytest.mark.parametrize(
    ("code", "payload"),
    [
        ("malformed", b"\xc1"),
        ("too_large", bytes(5 << 20)),
        ("bad_controls", encode(PredictQuery(3, np.zeros((3, 2))))),
        ("bad_controls", encode(PredictQuery(3, np.full((3, 1), 1e31)))),
        ("not_finite", encode(PredictQuery(3, np.zeros((3, 1)))).replace(bytes(24), b"\xff" * 24)),
    ],
)
@pytest.mark.usefixtures("cart")
def test_a_bad_payload_gets_an_error(koop: Loop, code: str, payload: bytes) -> None:
    reply = koop.ask_one("koop/predict/cart/0", payload)
    assert isinstance(reply, ErrorReply)
    assert reply.code == code
    assert_still_serving(koop)


def test_lqr_of_an_unforced_trajectory_gets_an_error(koop: Loop) -> None:
    Source(koop.session, "cart/still", control_size=0).stream(40)
    reply = koop.lqr("cart/still", LqrQuery(5, picture(0, 0)))
    assert isinstance(reply, ErrorReply)
    assert reply.code == "bad_controls"


@pytest.mark.usefixtures("cart")
def test_an_exception_of_ours_is_answered_and_logged(
    koop: Loop, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("a bug")

    with monkeypatch.context() as patch:
        patch.setattr("koop_service.serving.trajectories.forecasts.rollout", fail)
        reply = koop.predict("cart/0")
    assert isinstance(reply, ErrorReply)
    assert reply.code == "internal"
    assert "RuntimeError: a bug" in caplog.text
    assert_still_serving(koop)


def test_too_many_queries_are_told_so(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the pipeline is kept from answering, only the queue's number of queries is held."""
    with loop(config_for(tmp_path, model, queue_queries=3)) as koop:
        Source(koop.session, "cart/0").stream(40)
        koop.state("cart/0")
        wait_until(lambda: koop.service.metrics.value("koop_queue_queries") == 0)
        with monkeypatch.context() as patch:
            patch.setattr("koop_service.serving.answering.desk.Desk._is_due", lambda *_: False)
            waiting = [koop.session.get("koop/state/cart/0", timeout=DEADLINE) for _ in range(3)]
            wait_until(lambda: koop.service.metrics.value("koop_queue_queries") == 3)
            reply = koop.ask_one("koop/state/cart/0")
        assert isinstance(reply, ErrorReply)
        assert reply.code == "overloaded"
        for replies in waiting:
            assert [r.ok is not None for r in replies] == [True]
        assert isinstance(koop.ask_one("koop/state/cart/0"), StateReply)
