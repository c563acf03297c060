"""Frames to codes and back in batches: what the service calls."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial

import numpy as np
import torch
from torch import nn

from koop_service.encoding.autoencoder import Autoencoder, channels_first
from koop_service.encoding.folding import fold
from koop_service.encoding.inference import Network, computed_by, prepare
from koop_service.encoding.weights import ModelCard

_CPU_BATCH, _GPU_BATCH = 16 * 64 * 64, 128 * 64 * 64
"""Values of the frames in a batch. On a processor more do not fit the second-level cache, and are
no faster: 16 pictures of 64 x 64. A larger frame goes alone."""
_WORTH_HALVING = 8
"""Frames from which on two threads, each with half of them, are faster than one."""


class ImageCodec:
    """Encoder and decoder of one model on one device.

    A code's bits must not depend on the batch that its frame rode in, but batches of other sizes
    may take other kernels, and round differently. On a GPU every batch is therefore padded to the
    same size; on a processor one alone is, where it would differ. Another version of a library or
    another device may round differently: `computed_by` names them.
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
        self.largest_batch = max(1, values // math.prod(card.image_shape))
        encoder, decoder = fold(model)
        self._encoder = self._prepare(encoder, self._channels_first, place)
        self._decoder = self._prepare(decoder, (card.code_size, 1, 1), place)

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
        codes = self._encoder(images.reshape(-1, *self._channels_first))
        return codes.reshape(len(images), self.code_size).astype(np.float64)

    def decode(self, codes: np.ndarray, dtype: type | np.dtype = np.float32) -> np.ndarray:
        """Images (B, H, W) or (B, C, H, W) of codes (B, n), clipped to the card's range.

        For uint8 that is [0, 255].
        """
        images = self._decoder(codes.astype(np.float32)[:, :, None, None])
        images = images.reshape(len(codes), *self.image_shape).clip(*self.value_range)
        if np.dtype(dtype) == np.uint8:
            images = np.rint(images * 255)
        return images.astype(dtype)

    def _prepare(
        self, network: nn.Module, inputs: tuple[int, int, int], device: torch.device
    ) -> Network:
        """The network for any number of inputs (C, H, W)."""
        prepared = prepare(network, inputs, device)
        if not self._on_cpu:
            least = self.largest_batch
        elif self.largest_batch == 1 or _same_alone(prepared, inputs):
            least = 1
        else:
            least = 2
        return partial(_in_batches, prepared, least, self.largest_batch)


def _same_alone(network: Network, inputs: tuple[int, int, int]) -> bool:
    """Whether the processor's kernels give one alone the bits that it has among two."""
    two = np.random.default_rng(0).random((2, *inputs), np.float32)
    return np.array_equal(network(two)[:1], network(two[:1]))


def _in_batches(network: Network, least: int, largest: int, inputs: np.ndarray) -> np.ndarray:
    """The network's answers to inputs (B, C, H, W), between `least` and `largest` at once.

    Of none there are none.
    """
    parts = []
    for start in range(0, max(1, len(inputs)), largest):
        batch = inputs[start : start + largest]
        padding = batch[-1:].repeat(max(0, least - len(batch)), 0)
        answers = network(np.concatenate([batch, padding]) if len(padding) else batch)
        parts.append(answers[: len(batch)])
    return np.concatenate(parts)


@cache
def _helper() -> ThreadPoolExecutor:
    """One thread for all codecs, made when it is first needed."""
    return ThreadPoolExecutor(1, thread_name_prefix="koop-encoder")
