"""Frames to codes and back in batches: what the service calls."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import torch
from torch import Tensor, nn

from koop_service.encoding.autoencoder import Autoencoder, channels_first
from koop_service.encoding.folding import fold
from koop_service.encoding.packing import pack
from koop_service.encoding.weights import ModelCard

# Values of the frames in a batch. On a processor more do not fit the second-level cache, and are
# slower: 16 pictures of 64 x 64. A larger frame goes alone.
_CPU_BATCH, _GPU_BATCH = 16 * 64 * 64, 1024 * 64 * 64
_WORTH_HALVING = 8
"""Frames from which on two threads, each with half of them, are faster than one. Torch's own
threads hardly are, on networks as small as these."""


class ImageCodec:
    """Encoder and decoder of one model on one device.

    A code's bits must not depend on the batch that its frame rode in. Batches of two and more keep
    that on a CPU; one alone may take another kernel and round differently: where it does, it is
    padded, except where all go alone. Another version of torch or another device may round
    differently: `computed_by` names them.
    """

    def __init__(self, model: Autoencoder, card: ModelCard, device: str = "cpu") -> None:
        self.card = card
        self.code_size = card.code_size
        self.image_shape = card.image_shape
        self.value_range = card.value_range
        self.renderer = card.renderer
        self._device = torch.device(device)
        self.computed_by = f"torch {torch.__version__} on {self._device}"
        values = _CPU_BATCH if self._device.type == "cpu" else _GPU_BATCH
        self._largest = max(1, values // math.prod(card.image_shape))
        encoder, self._decoder = (part.to(self._device) for part in fold(model))
        self._encoder = pack(encoder) if self._device.type == "cpu" else encoder
        self._encodes_alone = self._same_alone(self._encoder)

    def encode(self, images: np.ndarray, *, hurried: bool = False) -> np.ndarray:
        """Codes (B, n) float64 of images (B, H, W) or (B, C, H, W): floats, or uint8 in 255ths.

        hurried: a large batch may take one more core; not a bit differs.
        """
        if not hurried or len(images) < _WORTH_HALVING or self._device.type != "cpu":
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
        scale = 1 / 255 if images.dtype == np.uint8 else 1.0
        pixels = torch.tensor(images).to(self._device, torch.float32).mul_(scale)
        inputs = pixels.reshape(-1, *channels_first(self.image_shape))
        codes = self._in_batches(self._encoder, inputs, alone=self._encodes_alone)
        return codes.reshape(len(images), self.code_size).astype(np.float64)

    def decode(self, codes: np.ndarray, dtype: type | np.dtype = np.float32) -> np.ndarray:
        """Images (B, H, W) or (B, C, H, W) of codes (B, n), clipped to the card's range.

        For uint8 that is [0, 255].
        """
        inputs = torch.tensor(codes, dtype=torch.float32, device=self._device)
        images = self._in_batches(self._decoder, inputs[:, :, None, None])
        images = images.reshape(len(codes), *self.image_shape).clip(*self.value_range)
        if np.dtype(dtype) == np.uint8:
            images = np.rint(images * 255)
        return images.astype(dtype)

    def _same_alone(self, encoder: nn.Module) -> bool:
        """Whether this processor's kernels give a picture alone the bits that it has among two."""
        random = torch.Generator().manual_seed(0)
        shape = (2, *channels_first(self.image_shape))
        pictures = torch.rand(shape, generator=random).to(self._device)
        both, alone = (self._in_batches(encoder, p, alone=True) for p in (pictures, pictures[:1]))
        return np.array_equal(both[:1], alone)

    def _in_batches(self, network: nn.Module, inputs: Tensor, alone: bool = False) -> np.ndarray:
        count = len(inputs)
        if count % self._largest == 1 and not alone:
            inputs = torch.cat([inputs, inputs[-1:]])
        inputs = inputs.contiguous(memory_format=torch.channels_last)
        with torch.inference_mode():
            parts = [network(batch) for batch in inputs.split(self._largest)]
            return torch.cat(parts)[:count].cpu().numpy()


@cache
def _helper() -> ThreadPoolExecutor:
    """One thread for all codecs, made when it is first needed."""
    return ThreadPoolExecutor(1, thread_name_prefix="koop-encoder")
