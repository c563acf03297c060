"""What each message refuses when it is built."""

from __future__ import annotations

import numpy as np
import pytest

from koop_protocol import (
    Command,
    Control,
    EndReason,
    ErrorCode,
    ErrorReply,
    Frame,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    PredictQuery,
    PredictReply,
    ProtocolError,
    StateReply,
)

EPOCH = "0123456789abcdef"
WHERE = {"trajectory": "cartpole/0", "epoch": EPOCH, "seq": 7}
IMAGE = np.zeros((4, 4), np.uint8)
STATE = {
    "trajectory": "cartpole/0",
    "epoch": EPOCH,
    "next_seq": 40,
    "model": "cartpole",
    "code_size": 8,
    "history": 2,
    "control_size": 1,
    "frames": 40,
    "updates": 38,
    "warmup_frames": 36,
    "ready": True,
    "residual_rms": 0.1,
    "spectral_radius": 0.99,
    "excitation": 3.0,
    "counters": {"gaps": 1},
}
LQR = {"horizon": 10, "target_code": np.zeros(3), "q": 1.0, "r": 1.0}
LQR_REPLY = {
    **WHERE,
    "status": "solved",
    "cost": 1.0,
    "kkt_residual": 0.0,
    "controls": np.zeros((2, 1)),
}


def with_nan(*shape: int, dtype: type = np.float64) -> np.ndarray:
    array = np.zeros(shape, dtype)
    array[(-1,) * len(shape)] = np.nan
    return array


def refused(type_: type, valid: dict, **changes: object) -> ProtocolError:
    type_(**valid)
    with pytest.raises(ProtocolError) as caught:
        type_(**{**valid, **changes})
    return caught.value


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"trajectory": "a b"}, ErrorCode.bad_key),
        ({"trajectory": 3}, ErrorCode.wrong_type),
        ({"epoch": "0123456789ABCDEF"}, ErrorCode.malformed),
        ({"epoch": EPOCH + "\n"}, ErrorCode.malformed),
        ({"epoch": 0}, ErrorCode.wrong_type),
        ({"seq": -1}, ErrorCode.malformed),
        ({"seq": 2**53}, ErrorCode.too_large),
        ({"seq": 1.0}, ErrorCode.wrong_type),
        ({"seq": False}, ErrorCode.wrong_type),
        ({"control_size": 65}, ErrorCode.too_large),
        ({"control_size": True}, ErrorCode.wrong_type),
        ({"image": [[1]]}, ErrorCode.wrong_type),
        ({"image": np.zeros(4, np.uint8)}, ErrorCode.wrong_shape),
        ({"image": np.zeros((0, 4), np.uint8)}, ErrorCode.wrong_shape),
        ({"image": np.zeros((1, 1, 4, 4), np.uint8)}, ErrorCode.wrong_shape),
        ({"image": np.zeros((1025, 1024), np.uint8)}, ErrorCode.too_large),
        ({"image": np.zeros((4, 4))}, ErrorCode.wrong_dtype),
        ({"image": np.zeros((4, 4), ">f4")}, ErrorCode.wrong_dtype),
        ({"image": np.zeros((4, 4), np.int8)}, ErrorCode.wrong_dtype),
        ({"image": with_nan(4, 4, dtype=np.float16)}, ErrorCode.not_finite),
        ({"image": with_nan(4, 4, dtype=np.float32)}, ErrorCode.not_finite),
        ({"renderer": None}, ErrorCode.wrong_type),
        ({"renderer": "ä" * 101}, ErrorCode.too_large),
        ({"renderer": "\ud800"}, ErrorCode.malformed),
    ],
)
def test_frame_refuses(change, code):
    assert refused(Frame, {**WHERE, "control_size": 1, "image": IMAGE}, **change).code == code


@pytest.mark.parametrize(
    ("u", "code"),
    [
        (np.array([np.nan]), ErrorCode.not_finite),
        (np.array([np.inf], np.float32), ErrorCode.not_finite),
        (np.zeros((1, 1)), ErrorCode.wrong_shape),
        (np.zeros(0), ErrorCode.wrong_shape),
        (np.zeros(65), ErrorCode.too_large),
        (np.zeros(1, np.int64), ErrorCode.wrong_dtype),
        (0.5, ErrorCode.wrong_type),
    ],
)
def test_control_refuses(u, code):
    assert refused(Control, {**WHERE, "u": np.zeros(1)}, u=u).code == code


def test_numpy_numbers_and_float32_become_canonical():
    control = Control("a", EPOCH, np.int64(3), np.ones(2, np.float32))
    assert type(control.seq) is int
    assert control.u.dtype == np.float64


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"horizon": 0}, ErrorCode.bad_horizon),
        ({"horizon": -5}, ErrorCode.bad_horizon),
        ({"horizon": 1001}, ErrorCode.bad_horizon),
        ({"horizon": 10**12}, ErrorCode.bad_horizon),
        ({"horizon": 20.0}, ErrorCode.wrong_type),
        ({"horizon": True}, ErrorCode.wrong_type),
        ({"returns": frozenset()}, ErrorCode.malformed),
        ({"returns": frozenset({"code"})}, ErrorCode.malformed),
        ({"returns": "codes"}, ErrorCode.wrong_type),
        ({"controls": np.zeros((3, 1))}, ErrorCode.bad_controls),
        ({"controls": np.zeros(4)}, ErrorCode.wrong_shape),
        ({"controls": with_nan(4, 1)}, ErrorCode.not_finite),
        ({"controls": np.zeros((4, 65))}, ErrorCode.too_large),
        ({"controls": np.zeros((4, 1), np.uint8)}, ErrorCode.wrong_dtype),
    ],
)
def test_predict_query_refuses(change, code):
    assert refused(PredictQuery, {"horizon": 4}, **change).code == code


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"codes": None}, ErrorCode.malformed),
        ({"codes": with_nan(4, 3)}, ErrorCode.not_finite),
        ({"codes": np.zeros((4, 3), np.float16)}, ErrorCode.wrong_dtype),
        ({"codes": np.zeros((4, 257))}, ErrorCode.too_large),
        ({"codes": np.zeros((1001, 1))}, ErrorCode.too_large),
        ({"std": np.zeros((4, 2))}, ErrorCode.wrong_shape),
        ({"frames": np.zeros((3, 4, 4), np.uint8)}, ErrorCode.wrong_shape),
        ({"frames": np.zeros((4, 4), np.uint8)}, ErrorCode.wrong_shape),
        ({"frames": np.zeros((4, 4, 4))}, ErrorCode.wrong_dtype),
        ({"frames": np.zeros((1001, 1, 1), np.uint8), "codes": None}, ErrorCode.too_large),
    ],
)
def test_predict_reply_refuses(change, code):
    assert refused(PredictReply, {**WHERE, "codes": np.zeros((4, 3))}, **change).code == code


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


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"code_size": 0}, ErrorCode.malformed),
        ({"history": 0}, ErrorCode.malformed),
        ({"frames": -1}, ErrorCode.malformed),
        ({"ready": 1}, ErrorCode.wrong_type),
        ({"excitation": np.nan}, ErrorCode.not_finite),
        ({"residual_rms": -0.1}, ErrorCode.malformed),
        ({"model": "x" * 201}, ErrorCode.too_large),
        ({"counters": []}, ErrorCode.wrong_type),
        ({"counters": {"gaps": -1}}, ErrorCode.malformed),
        ({"counters": {"gaps": True}}, ErrorCode.wrong_type),
        ({"counters": {1: 1}}, ErrorCode.wrong_type),
        ({"counters": {str(i): i for i in range(65)}}, ErrorCode.too_large),
    ],
)
def test_state_reply_refuses(change, code):
    assert refused(StateReply, STATE, **change).code == code


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"code": None}, ErrorCode.wrong_type),
        ({"message": "x" * 4097}, ErrorCode.too_large),
        ({"details": {"a": None}}, ErrorCode.wrong_type),
        ({"details": {"a": True}}, ErrorCode.wrong_type),
        ({"details": {"a": np.nan}}, ErrorCode.not_finite),
        ({"details": {"a": 2**60}}, ErrorCode.too_large),
    ],
)
def test_error_reply_refuses(change, code):
    assert refused(ErrorReply, {"code": "internal", "message": "m"}, **change).code == code
