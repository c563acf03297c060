"""Codes of frames in batches, and what becomes of a batch that cannot be encoded.

A device may be short of memory for a large batch, or gone; and nobody's frame must be lost for
another's.
"""

from __future__ import annotations

import logging
import time

import numpy as np
from numpy.typing import NDArray

from koop_protocol.checks import Image
from koop_service.encoding.image_codec import ImageCodec
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.instruments.metrics import Metrics

log = logging.getLogger("koop.encoder")

Array = NDArray[np.float64]


class EncoderError(Exception):
    """Nothing can be encoded at present, whatever the frames."""


class BatchEncoder:
    """Encodes for all models, and knows which of them fail."""

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._failing: set[ImageCodec] = set()
        self._brake = Brake()

    @property
    def fails(self) -> bool:
        """Whether some model could not encode what it last was given, by no frame's fault."""
        return bool(self._failing)

    def encode(
        self, codec: ImageCodec, images: list[Image], *, hurried: bool = False
    ) -> list[Array | None]:
        """A code (n,) for each image; None for one that cannot be encoded, though others can.

        Raises EncoderError where none can.
        """
        started = time.perf_counter()
        try:
            codes = codec.encode(_stack(images), hurried=hurried)
        except Exception as error:
            return self._apart(codec, images, error)
        self._metrics.encoding.observe(time.perf_counter() - started)
        self._metrics.batch.observe(len(images))
        self._failing.discard(codec)
        return list(codes)

    def _apart(
        self, codec: ImageCodec, images: list[Image], error: Exception
    ) -> list[Array | None]:
        """After an error: the halves of the batch one by one."""
        if not codec.is_sound():
            self._failing.add(codec)
            raise EncoderError(str(error)) from error
        self._failing.discard(codec)
        if self._brake.admit("batch") is not None:
            log.warning("a batch of %d could not be encoded", len(images), exc_info=error)
        if len(images) == 1:
            return [None]
        half = len(images) // 2
        return self.encode(codec, images[:half]) + self.encode(codec, images[half:])


def _stack(images: list[Image]) -> NDArray[np.generic]:
    batch = np.stack(images)
    return batch if batch.dtype == np.uint8 else batch.astype(np.float32, copy=False)
