"""Golden bytes: version 1 on the wire never changes, in either direction.

No line of the file is ever rewritten. A message that no longer matches it breaks every recorded
stream and every client in another language: raise the version instead. A message that gains
optional fields gets a line of its own; the bytes of the release before stay, to be read.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from koop_protocol import (
    Command,
    Control,
    Durable,
    Ending,
    EndReason,
    ErrorReply,
    Frame,
    Health,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    Message,
    PredictQuery,
    PredictReply,
    ReplayQuery,
    ReplayReply,
    StateReply,
    TrajectoryEnd,
    decode,
    encode,
)

GOLDEN: dict[str, str] = json.loads(
    (Path(__file__).parent / "golden" / "messages.json").read_text(encoding="utf-8")
)
WHERE = ("cartpole/0", "0123456789abcdef", 7)

EXAMPLES: dict[str, Message] = {
    "frame uint8": Frame(
        *WHERE, control_size=1, image=np.array([[0, 1], [128, 255]], np.uint8), renderer="capsules"
    ),
    "frame float16, camera": Frame(*WHERE, 0, np.array([[0.0, 0.5, 1.0]], np.float16)),
    "frame float32, channels": Frame(
        "line3/robot7", "fedcba9876543210", 2**53 - 1, 64, np.ones((3, 1, 2), np.float32)
    ),
    "frame, logged": Frame(*WHERE, 0, np.array([[7]], np.uint8), logged=True),
    "control": Control(*WHERE, np.array([0.25, -3.0])),
    "predict query, shortest": PredictQuery(),
    "predict query, controls": PredictQuery(
        2, np.array([[1.0], [-1.0]]), frozenset({"codes", "frames", "std"})
    ),
    "predict reply, codes": PredictReply(*WHERE, codes=np.array([[0.5, -0.5]])),
    "predict reply, all": PredictReply(
        *WHERE,
        codes=np.array([[1.5, 2.5]], np.float32),
        frames=np.array([[[9, 8]]], np.uint8),
        std=np.array([[0.1, 0.2]]),
    ),
    "lqr query, shortest": LqrQuery(5, target_code=np.array([1.0, 2.0])),
    "lqr query, everything": LqrQuery(
        10,
        target_image=np.array([[[0, 255]], [[255, 0]]], np.uint8),
        q=np.array([[2.0, 1.0], [1.0, 2.0]]),
        r=np.array([0.5, 1.0]),
        u_min=np.array([-30.0, -1.0]),
        u_max=np.array([30.0, 1.0]),
        returns=frozenset({"codes", "frames"}),
        qf="riccati",
        du_min=np.array([-3.0, 0.0]),
        du_max=np.array([3.0, 0.0]),
        known_channels=(1,),
        known_controls=np.array([[0.5], [0.25]]),
        delay=2,
        method="gain",
        force=True,
    ),
    "lqr reply, controls": LqrReply(
        *WHERE,
        status="solved",
        cost=1.25,
        kkt_residual=1e-9,
        controls=np.array([[3.0], [4.0]]),
        codes=np.array([[0.0], [1.0]]),
        frames=np.zeros((2, 1, 1), np.uint8),
        target_error=0.5,
        start=9,
        warnings=("the target cannot be held",),
        modes=np.array([[1.125, 0.0, 0.25, 7.5]]),
        scores=np.array([4.0]),
        information=np.array([250.0]),
        residual=0.75,
        band=2.0,
    ),
    "lqr reply, unfit": LqrReply(
        *WHERE,
        status="unfit",
        cost=0.0,
        kkt_residual=0.0,
        fit=False,
        reasons=("control 0 was hardly moved",),
        probing=np.array([[0.5], [-0.5]]),
    ),
    "lqr task": LqrTask(
        "client-7",
        LqrQuery(2, target_code=np.array([[1.0], [2.0]]), qf=np.array([3.0])),
        seconds=60.0,
        frozen=True,
    ),
    "lqr cancel": LqrCancel("client-7"),
    "command": Command(
        *WHERE,
        start=9,
        controls=np.array([[3.0], [4.0]]),
        status="solved",
        cost=1.25,
        kkt_residual=1e-9,
        owner="client-7",
    ),
    "lqr end": LqrEnd(
        "cartpole/0", "client-7", EndReason.owner_gone, "the task ended: its owner is gone"
    ),
    "state": StateReply(
        "cartpole/0",
        "0123456789abcdef",
        next_seq=40,
        model="cartpole",
        code_size=8,
        history=2,
        control_size=1,
        frames=40,
        updates=38,
        warmup_frames=36,
        ready=True,
        residual_rms=0.125,
        spectral_radius=0.75,
        excitation=2.5,
        counters={"duplicates": 0, "gaps": 1},
    ),
    "replay query, shortest": ReplayQuery(),
    "replay query, from a number": ReplayQuery("0123456789abcdef", 300, max_bytes=65536),
    "replay query, the next batch": ReplayQuery(after=1234),
    "replay query, no large messages": ReplayQuery(after=1234, max_message_bytes=65536),
    "replay reply": ReplayReply(
        "cartpole/0",
        (b"\x81\xa1v\x01", b"\x80"),
        position=1236,
        end=False,
        first_epoch="00000000000000aa",
        first_seq=0,
        last_epoch="0123456789abcdef",
        last_seq=301,
        dropped=5,
    ),
    "replay reply, empty": ReplayReply("cartpole/0", (), position=0, end=True),
    "health, shortest": Health("serve:7", "0.1.0", 0.5, 0, 0, 0),
    "health, degraded": Health(
        "serve:7", "0.1.0", 3600.0, 100, 12, 3, 0.25, ("overloaded", "not_durable")
    ),
    "trajectory end": TrajectoryEnd(
        "cartpole/0", "0123456789abcdef", 40, Ending.evicted, "idle for 900 s"
    ),
    "durable": Durable("cartpole/0", "0123456789abcdef", 299),
    "error": ErrorReply(
        "warming_up",
        "warming up, 12 of 36 frames",
        {"frames": 12, "warmup_frames": 36, "fraction": 0.5, "model": "cartpole"},
    ),
}


FORMER: dict[str, Message] = {
    "lqr query, image": LqrQuery(
        10,
        target_image=np.array([[0, 255]], np.uint8),
        q=2.0,
        r=0.5,
        u_min=np.array([-30.0]),
        u_max=np.array([30.0]),
        returns=frozenset({"codes", "frames"}),
    ),
    "lqr query, code and matrices": LqrQuery(
        5,
        target_code=np.array([1.0, 2.0]),
        q=np.array([[2.0, 1.0], [1.0, 2.0]]),
        r=np.array([0.5]),
    ),
    "lqr reply": LqrReply(
        *WHERE,
        status="solved",
        cost=1.25,
        kkt_residual=1e-9,
        controls=np.array([[3.0], [4.0]]),
        codes=np.array([[0.0], [1.0]]),
        frames=np.zeros((2, 1, 1), np.uint8),
        target_error=0.5,
    ),
}
"""Bytes of the release before; what they leave out has its default."""


@pytest.mark.parametrize("name", EXAMPLES)
def test_encoding_gives_the_golden_bytes(name):
    assert encode(EXAMPLES[name]).hex() == GOLDEN[name]


@pytest.mark.parametrize("name", EXAMPLES | FORMER)
def test_decoding_gives_the_golden_message(name):
    assert_same(decode(bytes.fromhex(GOLDEN[name])), (EXAMPLES | FORMER)[name])


def assert_same(message, expected):
    assert type(message) is type(expected)
    assert vars(message).keys() == vars(expected).keys()
    for field, value in vars(expected).items():
        found = getattr(message, field)
        if isinstance(value, LqrQuery):
            assert_same(found, value)
            continue
        assert type(found) is type(value), field
        assert np.asarray(found).dtype == np.asarray(value).dtype, field
        assert np.array_equal(found, value), field


def test_a_former_reply_begins_at_its_frame():
    assert FORMER["lqr reply"].start == WHERE[2]


def test_every_message_type_has_golden_bytes():
    assert set(GOLDEN) == set(EXAMPLES) | set(FORMER)
    assert {type(message) for message in EXAMPLES.values()} == set(Message.__args__)
