"""More pictures than fit into a measurement: replies and queries have limits of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from integration.loopback import Loop, Source, config_for, loop, picture

from koop_clients.queries import KoopClient, KoopError
from koop_protocol import ErrorCode, LqrQuery

FRAMES = frozenset({"frames"})


def watched(koop: Loop) -> KoopClient:
    """A client of a service that knows a trajectory of float32 pictures, 16 KB each."""
    source = Source(koop.session, "cart/0")
    for seq in range(40):
        source.put(source.frame(seq, image=grey(seq)))
        source.put(source.control(seq))
    return KoopClient(koop.session, timeout=30.0)


def grey(step: int) -> np.ndarray:
    return picture(0, step).astype(np.float32) / 255


def test_a_reply_may_be_larger_than_a_measurement(koop: Loop) -> None:
    client = watched(koop)
    frames = client.predict("cart/0", 400, returns=FRAMES).frames
    assert frames is not None
    assert frames.shape == (400, 64, 64)
    assert frames.nbytes > 4 << 20
    short = client.predict("cart/0", 5, returns=FRAMES).frames
    np.testing.assert_array_equal(frames[:5], short)


def test_who_asks_for_too_many_frames_is_told_how_many_fit(tmp_path: Path, model: Path) -> None:
    with loop(config_for(tmp_path, model, max_reply_bytes=400_000)) as koop:
        client = watched(koop)
        for horizon in (25, 200):
            with pytest.raises(KoopError, match=r"--max-reply-bytes") as caught:
                client.predict("cart/0", horizon, returns=FRAMES)
            assert caught.value.code == ErrorCode.too_large
            assert caught.value.details["frames"] == 23
            assert f"{horizon} frames of (64, 64) float32" in caught.value.message
        everything = {"frames", "codes", "std"}
        assert client.predict("cart/0", 23, returns=everything).std is not None
        assert client.predict("cart/0", 200, returns={"codes", "std"}).codes is not None
        query = LqrQuery(24, target_code=np.zeros(8), force=True, returns=FRAMES)
        with pytest.raises(KoopError, match="at most 23 in one reply"):
            client.lqr("cart/0", query)


def test_a_service_may_take_large_targets(tmp_path: Path, model: Path) -> None:
    pictures = np.stack([grey(step) for step in range(260)])
    query = LqrQuery(5, target_image=pictures, force=True)
    with loop(config_for(tmp_path / "a", model)) as koop:
        with pytest.raises(KoopError, match=r"has 42\d{5} bytes; .*--max-message-bytes") as caught:
            watched(koop).lqr("cart/0", query)
        assert caught.value.code == ErrorCode.too_large
    with loop(config_for(tmp_path / "b", model, max_message_bytes=5_000_000)) as koop:
        assert watched(koop).lqr("cart/0", query).controls is not None
