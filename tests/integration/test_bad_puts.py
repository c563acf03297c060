"""Puts that cannot be used: counted by reason, explained, and without effect on anybody else."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import msgpack
import numpy as np
import pytest
from integration.loopback import Loop, Source, wait_until

from koop_protocol import ErrorCode, encode, frame_key


def packed(source: Source, **changes: object) -> bytes:
    """Frame 40 with its msgpack map changed by hand."""
    return msgpack.packb({**msgpack.unpackb(encode(source.frame(40))), **changes})


def array(values: np.ndarray, **changes: object) -> dict[str, object]:
    fields = {"dtype": values.dtype.str[1:], "shape": values.shape, "data": values.tobytes()}
    return {**fields, **changes}


FLAT = np.zeros((64, 64), np.uint8)
NAN = np.full((64, 64), np.nan, np.float32)

FRAMES: dict[str, tuple[str, bytes | Callable[[Source], bytes]]] = {
    "not msgpack": ("malformed", b"\xc1 no message"),
    "cut short": ("malformed", lambda s: packed(s)[:-100]),
    "empty": ("malformed", b""),
    "a list": ("malformed", msgpack.packb([1, 2, 3])),
    "from the future": ("unsupported_version", lambda s: packed(s, v=2)),
    "of an unknown type": ("malformed", lambda s: packed(s, type="telegram")),
    "no image": ("malformed", lambda s: packed(s, image=None)),
    "wrong shape": ("wrong_shape", lambda s: packed(s, image=array(FLAT[:32]))),
    "a colour image": ("wrong_shape", lambda s: packed(s, image=array(np.stack([FLAT] * 3)))),
    "shape against data": ("wrong_shape", lambda s: packed(s, image=array(FLAT, shape=[64, 65]))),
    "absurd shape": ("wrong_shape", lambda s: packed(s, image=array(FLAT, shape=[2**40, 2**40]))),
    "wrong dtype": ("wrong_dtype", lambda s: packed(s, image=array(FLAT.astype(np.float64)))),
    "unknown dtype": ("wrong_dtype", lambda s: packed(s, image=array(FLAT, dtype="i4"))),
    "NaN": ("not_finite", lambda s: packed(s, image=array(NAN))),
    "floats up to 255": ("malformed", lambda s: packed(s, image=array(np.full_like(NAN, 200)))),
    "too large": ("too_large", bytes(5 << 20)),
    "negative number": ("malformed", lambda s: packed(s, seq=-1)),
    "a number of text": ("wrong_type", lambda s: packed(s, seq="40")),
    "no epoch": ("malformed", lambda s: packed(s, epoch="today")),
    "another renderer": ("renderer_mismatch", lambda s: packed(s, renderer="panda3d")),
    "another trajectory's": ("bad_key", lambda s: packed(s, trajectory="cart/other")),
    "other controls": ("wrong_shape", lambda s: packed(s, control_size=2)),
    "twice": ("stale_sequence", lambda s: packed(s, seq=39)),
    "backwards": ("stale_sequence", lambda s: packed(s, seq=7)),
    "a query": ("malformed", msgpack.packb({"v": 1, "type": "predict_query"})),
}

CONTROLS: dict[str, tuple[str, dict[str, object]]] = {
    "NaN": ("not_finite", {"u": array(np.array([math.nan]))}),
    "infinity": ("not_finite", {"u": array(np.array([math.inf]))}),
    "wrong size": ("wrong_shape", {"u": array(np.zeros(3))}),
    "a matrix": ("wrong_shape", {"u": array(np.zeros((1, 1)))}),
    "integers": ("wrong_dtype", {"u": array(np.zeros(1, np.uint8))}),
    "beyond measure": ("too_large", {"u": array(np.array([1e200]))}),
    "late": ("stale_sequence", {"seq": 3}),
}


def assert_rejected_alone(koop: Loop, cart: Source, reason: str) -> None:
    """Counted under its reason, the trajectory untouched, and a neighbour served all the while."""
    wait_until(lambda: koop.rejected(reason) == 1, f"the rejection as {reason}")
    state = koop.state("cart/0")
    assert state.next_seq == 40
    assert sum(n for name, n in state.counters.items() if name.startswith("rejected_")) == 1
    neighbour = Source(koop.session, "cart/neighbour", seed=5)
    neighbour.stream(40)
    assert koop.predict("cart/neighbour").seq == 39
    cart.put(cart.control(39))
    cart.put(cart.frame(40))
    assert koop.predict("cart/0").seq == 40
    assert koop.lost() == 0


@pytest.mark.parametrize("case", FRAMES)
def test_a_bad_frame_is_rejected_and_counted(koop: Loop, cart: Source, case: str) -> None:
    reason, make = FRAMES[case]
    cart.put_raw(frame_key("cart/0"), make if isinstance(make, bytes) else make(cart))
    assert_rejected_alone(koop, cart, reason)


@pytest.mark.parametrize("case", CONTROLS)
def test_a_bad_control_is_rejected_and_counted(koop: Loop, cart: Source, case: str) -> None:
    reason, changes = CONTROLS[case]
    fields = msgpack.unpackb(encode(cart.control(39)))
    key = frame_key("cart/0").replace("frame", "control")
    cart.put_raw(key, msgpack.packb({**fields, **changes}))
    assert_rejected_alone(koop, cart, reason)


@pytest.mark.parametrize(
    "key",
    ["koop/frame/00/cart/0", "koop/frame/cart/0", "koop/control/1b/cart/0", "koop/frame/zz"],
)
def test_a_frame_on_a_wrong_key_is_rejected(koop: Loop, cart: Source, key: str) -> None:
    cart.put_raw(key, encode(cart.frame(40)))
    wait_until(lambda: koop.rejected("bad_key") == 1)
    assert koop.state("cart/0").next_seq == 40


@pytest.mark.usefixtures("cart")
def test_a_delete_is_rejected(koop: Loop) -> None:
    koop.session.delete(frame_key("cart/0"))
    wait_until(lambda: koop.rejected("malformed") == 1)
    assert koop.state("cart/0").next_seq == 40


def test_the_asker_learns_why_nothing_of_it_was_taken(koop: Loop) -> None:
    source = Source(koop.session, "cart/painted", renderer="panda3d")
    source.stream(3)
    reply = koop.predict("cart/painted")
    assert reply.code == ErrorCode.unknown_trajectory
    assert "'panda3d'" in reply.message
    assert reply.details["refused"] == "renderer_mismatch"


def test_a_trajectory_without_a_model_is_told_how_to_get_one(koop: Loop) -> None:
    Source(koop.session, "crane/0").stream(2)
    wait_until(lambda: koop.rejected("no_model") == 2)
    reply = koop.predict("crane/0")
    assert reply.code == ErrorCode.no_model
    assert "no model for trajectory 'crane/0'" in reply.message
    for word in ("koop-dataset", "koop-train", "--models"):
        assert word in reply.message


def test_a_control_before_any_frame_is_rejected(koop: Loop) -> None:
    source = Source(koop.session, "cart/0")
    source.put(source.control(0))
    wait_until(lambda: koop.rejected("unknown_trajectory") == 1)


def test_a_gap_is_counted_and_never_learned_across(koop: Loop, cart: Source) -> None:
    before = koop.state("cart/0").updates
    cart.stream(70, start=50)
    state = koop.state("cart/0")
    assert (state.next_seq, state.counters["gaps"]) == (70, 1)
    assert state.counters["missing_frames"] == 10
    assert state.updates == before + 18


def test_an_exception_of_ours_loses_one_batch_and_is_counted(
    koop: Loop, cart: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault in the encoder must not end the pipeline."""
    koop.state("cart/0")

    def fail(*_: object) -> None:
        raise RuntimeError("the encoder is on fire")

    with monkeypatch.context() as patch:
        patch.setattr("koop_service.encoding.image_codec.ImageCodec.encode", fail)
        cart.put(cart.frame(40))
        wait_until(lambda: koop.lost() == 1)
    fresh = replace(cart, epoch="00000000000000bb")
    fresh.stream(40)
    assert koop.predict("cart/0").epoch == fresh.epoch
