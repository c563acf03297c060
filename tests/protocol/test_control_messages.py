"""What the messages of control refuse when they are built."""

from __future__ import annotations

import numpy as np
import pytest

from koop_protocol import (
    Command,
    EndReason,
    ErrorCode,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    ProtocolError,
)

from .refusing import IMAGE, WHERE, refused, with_nan

LQR = {"horizon": 10, "target_code": np.zeros(3), "q": 1.0, "r": 1.0}
LQR_REPLY = {
    **WHERE,
    "status": "solved",
    "cost": 1.0,
    "kkt_residual": 0.0,
    "controls": np.zeros((2, 1)),
}
UNSYMMETRIC = np.array([[1.0, 0.5], [0.4, 1.0]])
INDEFINITE = np.array([[1.0, 2.0], [2.0, 1.0]])
SINGULAR = np.array([[1.0, 1.0], [1.0, 1.0]])


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"target_code": None}, ErrorCode.bad_target),
        ({"target_image": IMAGE}, ErrorCode.bad_target),
        ({"target_code": with_nan(3)}, ErrorCode.not_finite),
        ({"target_code": np.zeros((1, 1, 3))}, ErrorCode.wrong_shape),
        ({"target_code": np.zeros((1001, 3))}, ErrorCode.too_large),
        ({"target_code": with_nan(2, 3)}, ErrorCode.not_finite),
        ({"target_code": np.zeros((2, 3)), "q": np.ones(2)}, ErrorCode.bad_weights),
        (
            {"target_code": None, "target_image": np.zeros((1, 2, 1, 4, 4), np.uint8)},
            ErrorCode.wrong_shape,
        ),
        ({"target_code": None, "target_image": np.zeros(4, np.uint8)}, ErrorCode.wrong_shape),
        ({"horizon": 0}, ErrorCode.bad_horizon),
        ({"q": -1.0}, ErrorCode.bad_weights),
        ({"q": np.nan}, ErrorCode.not_finite),
        ({"q": 10**400}, ErrorCode.not_finite),
        ({"q": "1"}, ErrorCode.wrong_type),
        ({"q": True}, ErrorCode.wrong_type),
        ({"q": np.array([1.0, 1.0, -1e-3])}, ErrorCode.bad_weights),
        ({"q": np.array([1.0, 1.0])}, ErrorCode.bad_weights),
        ({"q": np.ones((3, 2))}, ErrorCode.wrong_shape),
        ({"q": np.ones((1, 3, 3))}, ErrorCode.wrong_shape),
        ({"q": np.eye(257)}, ErrorCode.too_large),
        ({"q": UNSYMMETRIC}, ErrorCode.bad_weights),
        ({"q": INDEFINITE}, ErrorCode.bad_weights),
        ({"q": with_nan(3, 3)}, ErrorCode.not_finite),
        ({"r": 0.0}, ErrorCode.bad_weights),
        ({"r": 0}, ErrorCode.bad_weights),
        ({"r": -1.0}, ErrorCode.bad_weights),
        ({"r": np.inf}, ErrorCode.not_finite),
        ({"r": np.array([1.0, 0.0])}, ErrorCode.bad_weights),
        ({"r": np.zeros((2, 2))}, ErrorCode.bad_weights),
        ({"r": UNSYMMETRIC}, ErrorCode.bad_weights),
        ({"r": INDEFINITE}, ErrorCode.bad_weights),
        ({"r": INDEFINITE * 1e300}, ErrorCode.bad_weights),
        ({"r": SINGULAR - np.eye(2) * 1e-6}, ErrorCode.bad_weights),
        ({"u_min": np.array([np.nan])}, ErrorCode.not_finite),
        ({"u_max": np.array([np.inf])}, ErrorCode.not_finite),
        ({"u_min": -1.0}, ErrorCode.wrong_type),
        ({"u_min": np.array([1.0]), "u_max": np.array([-1.0])}, ErrorCode.bad_bounds),
        ({"u_min": np.zeros(2), "u_max": np.array([1.0, -1e-9])}, ErrorCode.bad_bounds),
        ({"u_min": np.zeros(2), "u_max": np.ones(1)}, ErrorCode.bad_bounds),
        ({"r": np.ones(2), "u_max": np.ones(1)}, ErrorCode.bad_bounds),
        ({"returns": frozenset({"std"})}, ErrorCode.malformed),
        ({"qf": "ricatti"}, ErrorCode.malformed),
        ({"qf": -1.0}, ErrorCode.bad_weights),
        ({"qf": np.ones(2)}, ErrorCode.bad_weights),
        ({"qf": True}, ErrorCode.wrong_type),
        ({"du_min": np.array([0.1])}, ErrorCode.bad_bounds),
        ({"du_max": np.array([-0.1])}, ErrorCode.bad_bounds),
        ({"du_max": np.ones(2), "u_max": np.ones(1)}, ErrorCode.bad_bounds),
        ({"du_max": np.array([np.inf])}, ErrorCode.not_finite),
        ({"known_channels": (1,)}, ErrorCode.bad_controls),
        ({"known_controls": np.zeros((2, 1))}, ErrorCode.bad_controls),
        ({"known_channels": (1, 1), "known_controls": np.zeros((2, 2))}, ErrorCode.bad_controls),
        ({"known_channels": (1,), "known_controls": np.zeros((2, 2))}, ErrorCode.bad_controls),
        ({"known_channels": (64,), "known_controls": np.zeros((2, 1))}, ErrorCode.too_large),
        ({"known_channels": (1.0,), "known_controls": np.zeros((2, 1))}, ErrorCode.wrong_type),
        ({"known_channels": 1, "known_controls": np.zeros((2, 1))}, ErrorCode.wrong_type),
        ({"known_channels": (1,), "known_controls": with_nan(2, 1)}, ErrorCode.not_finite),
        ({"delay": -1}, ErrorCode.malformed),
        ({"delay": 1001}, ErrorCode.too_large),
        ({"delay": 0.5}, ErrorCode.wrong_type),
        ({"method": "pid"}, ErrorCode.malformed),
        ({"method": 1}, ErrorCode.wrong_type),
        ({"force": 1}, ErrorCode.wrong_type),
    ],
)
def test_lqr_query_refuses(change, code):
    assert refused(LqrQuery, LQR, **change).code == code


@pytest.mark.parametrize(
    "change",
    [
        {"q": 0.0},
        {"q": 0},
        {"q": np.zeros((3, 3))},
        {"q": np.array([0.0, 1.0, 2.0])},
        {"r": np.array([[2.0, 1.0], [1.0, 2.0]]) * 1e-300},
        {"u_min": np.ones(2), "u_max": np.ones(2)},
        {"u_min": np.full(2, -3.0)},
        {"target_code": None, "target_image": IMAGE},
        {"target_code": None, "target_image": np.zeros((5, 1, 4, 4), np.uint8)},
        {"target_code": np.zeros((5, 3))},
        {"qf": "riccati"},
        {"qf": 0.0},
        {"du_min": np.zeros(1), "du_max": np.zeros(1)},
        {"known_channels": np.array([1, 0]), "known_controls": np.zeros((9, 2), np.float32)},
    ],
)
def test_lqr_query_takes(change):
    assert LqrQuery(**{**LQR, **change}).horizon == 10


def test_a_semidefinite_product_passes_as_q():
    factor = np.random.default_rng(0).normal(size=(2, 3))
    assert isinstance(LqrQuery(**{**LQR, "q": factor.T @ factor}).q, np.ndarray)


def test_bounds_name_the_component_that_crosses():
    bounds = {"u_min": np.array([0.0, 2.0]), "u_max": np.array([1.0, 1.0])}
    with pytest.raises(ProtocolError, match=r"above u_max in component 1: 2.0 > 1.0; expected"):
        LqrQuery(**LQR, **bounds)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"cost": np.nan}, ErrorCode.not_finite),
        ({"kkt_residual": np.inf}, ErrorCode.not_finite),
        ({"kkt_residual": -1.0}, ErrorCode.malformed),
        ({"target_error": np.nan}, ErrorCode.not_finite),
        ({"status": 1}, ErrorCode.wrong_type),
        ({"controls": None}, ErrorCode.malformed),
        ({"controls": [[0.0]]}, ErrorCode.wrong_type),
        ({"controls": with_nan(2, 1)}, ErrorCode.not_finite),
        ({"start": 6}, ErrorCode.malformed),
        ({"fit": 0}, ErrorCode.wrong_type),
        ({"reasons": "why"}, ErrorCode.wrong_type),
        ({"reasons": (1,)}, ErrorCode.wrong_type),
        ({"warnings": ("x" * 4097,)}, ErrorCode.too_large),
        ({"warnings": ("x",) * 65}, ErrorCode.too_large),
        ({"modes": np.zeros((1, 5))}, ErrorCode.too_large),
        ({"modes": np.zeros((1, 3))}, ErrorCode.wrong_shape),
        ({"scores": np.array([np.inf])}, ErrorCode.not_finite),
        ({"band": np.inf}, ErrorCode.not_finite),
        ({"residual": -1.0}, ErrorCode.malformed),
        ({"probing": with_nan(2, 1)}, ErrorCode.not_finite),
        ({"codes": np.zeros((3, 8))}, ErrorCode.wrong_shape),
        ({"frames": np.zeros((1, 4, 4), np.uint8)}, ErrorCode.wrong_shape),
    ],
)
def test_lqr_reply_refuses(change, code):
    assert refused(LqrReply, LQR_REPLY, **change).code == code


def test_a_reply_without_controls_says_that_the_model_is_not_fit():
    reply = LqrReply(**{**LQR_REPLY, "controls": None, "fit": False, "reasons": ["because"]})
    assert reply.reasons == ("because",)
    assert reply.start == reply.seq == 7


TASK = {"owner": "me", "query": LqrQuery(**LQR)}


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"owner": "a/b"}, ErrorCode.bad_key),
        ({"owner": None}, ErrorCode.wrong_type),
        ({"query": {"horizon": 3}}, ErrorCode.wrong_type),
        ({"query": LqrQuery(**LQR, returns=frozenset({"codes"}))}, ErrorCode.malformed),
        ({"seconds": 0}, ErrorCode.malformed),
        ({"seconds": -1.0}, ErrorCode.malformed),
        ({"seconds": np.inf}, ErrorCode.not_finite),
        ({"frozen": None}, ErrorCode.wrong_type),
    ],
)
def test_lqr_task_refuses(change, code):
    assert refused(LqrTask, TASK, **change).code == code


def test_lqr_cancel_refuses():
    assert refused(LqrCancel, {"owner": "me"}, owner="").code == ErrorCode.bad_key


COMMAND = {
    **WHERE,
    "start": 8,
    "controls": np.zeros((2, 1)),
    "status": "solved",
    "cost": 1.0,
    "kkt_residual": 0.0,
    "owner": "me",
}


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"start": 6}, ErrorCode.malformed),
        ({"controls": None}, ErrorCode.wrong_type),
        ({"controls": with_nan(2, 1)}, ErrorCode.not_finite),
        ({"cost": np.inf}, ErrorCode.not_finite),
        ({"kkt_residual": -1e-9}, ErrorCode.malformed),
        ({"owner": "@"}, ErrorCode.bad_key),
    ],
)
def test_command_refuses(change, code):
    assert refused(Command, COMMAND, **change).code == code


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"reason": "bored"}, ErrorCode.malformed),
        ({"reason": 1}, ErrorCode.wrong_type),
        ({"message": None}, ErrorCode.wrong_type),
        ({"trajectory": "@"}, ErrorCode.bad_key),
    ],
)
def test_lqr_end_refuses(change, code):
    end = {"trajectory": "a", "owner": "me", "reason": "expired", "message": "m"}
    assert refused(LqrEnd, end, **change).code == code
    assert LqrEnd(**end).reason is EndReason.expired
