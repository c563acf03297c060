"""Batches that cannot be encoded: for want of memory, for one frame's fault, or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from koop_service.serving.encoding import BatchEncoder, EncoderError
from koop_service.serving.instruments.metrics import Metrics

IMAGES = [np.full((64, 64), i, np.uint8) for i in range(11)]


class Codec:
    """A picture's code is its first value. `room` is for so many at once; `odd` breaks it."""

    def __init__(self, room: int = 64, odd: int = -1) -> None:
        self.room, self.odd = room, odd
        self.batches: list[int] = []

    def encode(self, images: np.ndarray, **_: bool) -> np.ndarray:
        if len(images) > self.room or self.odd in images[:, 0, 0]:
            raise RuntimeError("out of memory")
        self.batches.append(len(images))
        return images[:, 0, :1].astype(np.float64)

    def is_sound(self) -> bool:
        return self.room > 0


@pytest.fixture
def encoder() -> BatchEncoder:
    return BatchEncoder(Metrics())


def test_too_large_a_batch_is_encoded_in_parts(encoder: BatchEncoder) -> None:
    codec = Codec(room=3)
    codes = encoder.encode(codec, IMAGES)
    assert [code.item() for code in codes] == list(range(11))
    assert max(codec.batches) <= 3
    assert not encoder.fails


def test_one_odd_frame_takes_no_other_along(encoder: BatchEncoder) -> None:
    codes = encoder.encode(Codec(odd=4), IMAGES)
    assert [code is None for code in codes] == [i == 4 for i in range(11)]
    assert [code.item() for code in codes if code is not None] == [0, 1, 2, 3, *range(5, 11)]
    assert not encoder.fails


def test_who_can_encode_nothing_fails_until_he_can(encoder: BatchEncoder) -> None:
    codec, other = Codec(room=0), Codec()
    with pytest.raises(EncoderError, match="out of memory"):
        encoder.encode(codec, IMAGES)
    assert encoder.fails
    encoder.encode(other, IMAGES)
    assert encoder.fails, "another model's codec is another matter"
    codec.room = 64
    assert len(encoder.encode(codec, IMAGES)) == 11
    assert not encoder.fails


def test_it_fails_no_more_where_only_the_frame_is_odd(encoder: BatchEncoder) -> None:
    codec = Codec(room=0)
    with pytest.raises(EncoderError):
        encoder.encode(codec, IMAGES[:1])
    codec.room, codec.odd = 64, 0
    assert encoder.encode(codec, IMAGES[:1]) == [None]
    assert not encoder.fails
