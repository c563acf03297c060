"""Frames to codes and back in batches: what the service calls."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import torch

from koop_service.encoding.autoencoder import Autoencoder, channels_first
from koop_service.encoding.folding import fold
from koop_service.encoding.inference import Network, computed_by, prepare
from koop_service.encoding.weights import ModelCard

# Values of the frames in a batch. On a processor more do not fit the second-level cache, and are
# slower: 16 pictures of 64 x 64. A larger frame goes alone.
_CPU_BATCH, _GPU_BATCH = 16 * 64 * 64, 1024 * 64 * 64
_WORTH_HALVING = 8
"""Frames from which on two threads, each with half of them, are faster than one. Torch's own
threads hardly are, on networks as small as these."""


class ImageCodec:
    """Encoder and decoder of one model on one device.

    A code's bits must not depend on the batch that its frame rode in. One alone may take another
    kernel and round differently: where it does, it is padded, except where all go alone. Another
    version of a library or another device may round differently: `computed_by` names them.
    """

    def __init__(self, model: Autoencoder, card: ModelCard, device: str = "cpu") -> None:
        self.card = card
        self.code_size = card.code_size
        self.image_shape = card.image_shape
        self.value_range = card.value_range
        self.renderer = card.renderer
        place = torch.device(device)
        self.computed_by = computed_by(place)
        self._on_cpu = place.type == "cpu"
        self._channels_first = channels_first(card.image_shape)
        values = _CPU_BATCH if self._on_cpu else _GPU_BATCH
        self._largest = max(1, values // math.prod(card.image_shape))
        encoder, decoder = fold(model)
        self._encoder = prepare(encoder, self._channels_first, place)
        self._decoder = prepare(decoder, (card.code_size, 1, 1), place)
        self._encodes_alone = self._same_alone()

    def encode(self, images: np.ndarray, *, hurried: bool = False) -> np.ndarray:
        """Codes (B, n) float64 of images (B, H, W) or (B, C, H, W): floats, or uint8 in 255ths.

        hurried: a large batch may take one more core; not a bit differs.
        """
        if not hurried or len(images) < _WORTH_HALVING or not self._on_cpu:
            return self._encode(images)
        half = len(images) // 2
        first = _helper().submit(self._encode, images[:half])
        second = self._encode(images[half:])
        return np.concatenate([first.result(), second])

    def is_sound(self) -> bool:
        """Whether an empty picture can be encoded; where not, no picture is to blame."""
        try:
            self.encode(np.zeros((1, *self.image_shape), np.float32))
        except Exception:
            return False
        return True

    def _encode(self, images: np.ndarray) -> np.ndarray:
        inputs = images.reshape(-1, *self._channels_first)
        codes = self._in_batches(self._encoder, inputs, alone=self._encodes_alone)
        return codes.reshape(len(images), self.code_size).astype(np.float64)

    def decode(self, codes: np.ndarray, dtype: type | np.dtype = np.float32) -> np.ndarray:
        """Images (B, H, W) or (B, C, H, W) of codes (B, n), clipped to the card's range.

        For uint8 that is [0, 255].
        """
        inputs = codes.astype(np.float32)[:, :, None, None]
        images = self._in_batches(self._decoder, inputs)
        images = images.reshape(len(codes), *self.image_shape).clip(*self.value_range)
        if np.dtype(dtype) == np.uint8:
            images = np.rint(images * 255)
        return images.astype(dtype)

    def _same_alone(self) -> bool:
        """Whether the encoder's kernels give a picture alone the bits that it has among two."""
        pictures = np.random.default_rng(0).random((2, *self._channels_first), np.float32)
        both, alone = (
            self._in_batches(self._encoder, p, alone=True) for p in (pictures, pictures[:1])
        )
        return np.array_equal(both[:1], alone)

    def _in_batches(self, network: Network, inputs: np.ndarray, alone: bool = False) -> np.ndarray:
        count = len(inputs)
        if count % self._largest == 1 and not alone:
            inputs = np.concatenate([inputs, inputs[-1:]])
        starts = range(0, len(inputs), self._largest)
        return np.concatenate([network(inputs[i : i + self._largest]) for i in starts])[:count]


@cache
def _helper() -> ThreadPoolExecutor:
    """One thread for all codecs, made when it is first needed."""
    return ThreadPoolExecutor(1, thread_name_prefix="koop-encoder")
