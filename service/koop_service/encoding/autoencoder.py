"""The paper's convolutional autoencoder (section 3.1, A.1): 117,963 parameters at n_z = 8.

The same blocks serve pictures of other sizes and channels; see `architecture`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from koop_service.encoding.architecture import PAPER, Architecture

IMAGE_SIZE = 64

Shape = tuple[int, ...]
Size = tuple[int, int]


def channels_first(image_shape: Shape) -> tuple[int, int, int]:
    """(C, H, W) of pictures (H, W), whose channel goes without saying, or (C, H, W)."""
    channels, height, width = image_shape if len(image_shape) == 3 else (1, *image_shape)
    return channels, height, width


class Autoencoder(nn.Module):
    """Encoder Phi: (B, C, H, W) -> (B, n); decoder Psi: (B, n) -> (B, C, H, W) (eq. 2).

    Encoder blocks `Conv 3x3 -> MaxPool 2 -> BatchNorm -> ReLU`, no ReLU in the last; as many
    decoder blocks `ConvTranspose, stride 2 -> BatchNorm -> ReLU`, no ReLU in the last. The
    innermost block of each goes over all that the halvings before it leave: the paper's over 2 x 2.
    """

    def __init__(
        self,
        code_size: int = 8,
        image_shape: Shape = (IMAGE_SIZE, IMAGE_SIZE),
        architecture: Architecture = PAPER,
    ) -> None:
        super().__init__()
        self.code_size, self.image_shape, self.architecture = code_size, image_shape, architecture
        channels, height, width = channels_first(image_shape)
        left = architecture.remainder(height, width)
        down = (channels, *architecture.channels, code_size)
        halvings = [(2, 2)] * len(architecture.channels)
        self.encoder = nn.Sequential(
            *_blocks(_encoder_block, down, [(f,) for f in (*halvings, left)])
        )
        # The innermost patch has no neighbours to overlap with.
        overlaps = [0, *[architecture.overlap] * len(halvings)]
        up = list(zip([left, *halvings], overlaps, strict=True))
        self.decoder = nn.Sequential(*_blocks(_decoder_block, down[::-1], up))

    def encode(self, images: Tensor) -> Tensor:
        """Codes (B, n) of images (B, C, H, W)."""
        return self.encoder(images).flatten(1)

    def decode(self, codes: Tensor) -> Tensor:
        """Images (B, C, H, W) of codes (B, n)."""
        return self.decoder(codes[:, :, None, None])

    def match_output_scale(self, mean: Tensor, std: Tensor) -> None:
        """Start the last BatchNorm at the pictures' means and standard deviations (C,).

        Left at one it would take Adam hundreds of steps to shrink that one number.
        """
        last = [m for m in self.decoder.modules() if isinstance(m, nn.BatchNorm2d)][-1]
        with torch.no_grad():
            last.weight.copy_(std)
            last.bias.copy_(mean)

    def freeze_statistics(self) -> None:
        """Normalise by the running statistics from now on, in training as in inference."""
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def initialised(
    code_size: int,
    seed: int,
    image_shape: Shape = (IMAGE_SIZE, IMAGE_SIZE),
    architecture: Architecture = PAPER,
) -> Autoencoder:
    """A fresh autoencoder; the same seed gives the same parameters."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Autoencoder(code_size, image_shape, architecture)


def _blocks(
    block: Callable[..., nn.Module], channels: Shape, scalings: Sequence[tuple[Any, ...]]
) -> list[nn.Module]:
    """Blocks between neighbours of `channels`; each scales the picture in its own way."""
    pairs = list(itertools.pairwise(channels))
    last = len(pairs) - 1
    return [block(a, b, i == last, *scalings[i]) for i, (a, b) in enumerate(pairs)]


def _encoder_block(inputs: int, outputs: int, last: bool, factor: Size) -> nn.Sequential:
    conv = nn.Conv2d(inputs, outputs, 3, padding=1)
    layers = [conv, nn.MaxPool2d(factor), nn.BatchNorm2d(outputs)]
    return nn.Sequential(*layers, *([] if last else [nn.ReLU()]))


def _decoder_block(
    inputs: int, outputs: int, last: bool, factor: Size, overlap: int
) -> nn.Sequential:
    kernel = factor[0] + overlap, factor[1] + overlap
    conv = nn.ConvTranspose2d(inputs, outputs, kernel, factor, padding=overlap // 2)
    layers = [conv, nn.BatchNorm2d(outputs)]
    return nn.Sequential(*layers, *([] if last else [nn.ReLU()]))
