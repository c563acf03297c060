"""What each message refuses when it is built."""

from __future__ import annotations

import numpy as np
import pytest

from koop_protocol import (
    Control,
    ErrorCode,
    ErrorReply,
    Frame,
    PredictQuery,
    PredictReply,
    StateReply,
)

from .refusing import EPOCH, IMAGE, WHERE, refused, with_nan

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
        ({"logged": 1}, ErrorCode.wrong_type),
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
