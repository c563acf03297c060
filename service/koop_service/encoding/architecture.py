"""What rebuilds a network, beside the sizes of its pictures and codes: stands in the model card."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Architecture:
    """Channels between the encoder's blocks; the decoder is their mirror.

    Every block halves the picture, the last one pools what is then left to one. `overlap` is how
    many pixels neighbouring patches of the decoder share: 0 as in the paper, where pictures are put
    together from 2 x 2 pixels that know nothing of the next ones, or 2, for smooth fields.
    """

    channels: tuple[int, ...] = (16, 32, 64, 64, 32)
    overlap: int = 0

    def __post_init__(self) -> None:
        counts = all(type(count) is int and count >= 1 for count in self.channels)
        if not self.channels or not counts or self.overlap not in (0, 2):
            raise ValueError(
                f"{self} cannot be built; expected channels of at least 1, and an overlap of 0 or 2"
            )

    def remainder(self, height: int, width: int) -> tuple[int, int]:
        """What the last block pools to one. Raises ValueError where the others cannot halve."""
        factor = 2 ** len(self.channels)
        if height % factor or width % factor:
            raise ValueError(
                f"pictures of {height} x {width} cannot be halved {len(self.channels)} times; "
                f"expected sides that are multiples of {factor}: cut or scale them"
            )
        return height // factor, width // factor

    @classmethod
    def from_fields(cls, fields: Mapping[str, Any]) -> Architecture:
        """From JSON, which has lists."""
        return cls(**{**fields, "channels": tuple(fields["channels"])})


PAPER = Architecture()
"""The paper's (section 3.1, A.1), for pictures of 64 x 64."""
FLOW = Architecture(channels=(16, 32, 64, 64, 64, 32), overlap=2)
"""Ours for fields of 128 x 256: one block more."""
