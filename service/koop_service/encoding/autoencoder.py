"""The paper's convolutional autoencoder (section 3.1, A.1): 117,963 parameters at n_z = 8."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
from torch import Tensor, nn

IMAGE_SIZE = 64
_CHANNELS = (16, 32, 64, 64, 32)


class Autoencoder(nn.Module):
    """Encoder Phi: (B, 1, 64, 64) -> (B, n); decoder Psi: (B, n) -> (B, 1, 64, 64) (eq. 2).

    Six encoder blocks `Conv 3x3 -> MaxPool 2 -> BatchNorm -> ReLU`, no ReLU in the last; six
    decoder blocks `ConvTranspose 2x2 stride 2 -> BatchNorm -> ReLU`, no ReLU in the last.
    """

    def __init__(self, code_size: int = 8) -> None:
        super().__init__()
        self.code_size = code_size
        down = (1, *_CHANNELS, code_size)
        up = down[::-1]
        self.encoder = nn.Sequential(*_blocks(_encoder_block, down))
        self.decoder = nn.Sequential(*_blocks(_decoder_block, up))

    def encode(self, images: Tensor) -> Tensor:
        """Codes (B, n) of images (B, 1, 64, 64) in [0, 1]."""
        return self.encoder(images).flatten(1)

    def decode(self, codes: Tensor) -> Tensor:
        """Images (B, 1, 64, 64) of codes (B, n)."""
        return self.decoder(codes[:, :, None, None])

    def match_output_scale(self, mean: float, std: float) -> None:
        """Start the last BatchNorm at the pictures' mean and standard deviation.

        Left at one it would take Adam hundreds of steps to shrink that single scalar.
        """
        last = [m for m in self.decoder.modules() if isinstance(m, nn.BatchNorm2d)][-1]
        nn.init.constant_(last.weight, std)
        nn.init.constant_(last.bias, mean)

    def freeze_statistics(self) -> None:
        """Normalise by the running statistics from now on, in training as in inference."""
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def initialised(code_size: int, seed: int) -> Autoencoder:
    """A fresh autoencoder; the same seed gives the same parameters."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Autoencoder(code_size)


def _blocks(
    block: Callable[[int, int, bool], nn.Module], channels: tuple[int, ...]
) -> list[nn.Module]:
    pairs = list(itertools.pairwise(channels))
    return [block(a, b, i == len(pairs) - 1) for i, (a, b) in enumerate(pairs)]


def _encoder_block(inputs: int, outputs: int, last: bool) -> nn.Sequential:
    layers = [nn.Conv2d(inputs, outputs, 3, padding=1), nn.MaxPool2d(2), nn.BatchNorm2d(outputs)]
    return nn.Sequential(*layers, *([] if last else [nn.ReLU()]))


def _decoder_block(inputs: int, outputs: int, last: bool) -> nn.Sequential:
    layers = [nn.ConvTranspose2d(inputs, outputs, 2, stride=2), nn.BatchNorm2d(outputs)]
    return nn.Sequential(*layers, *([] if last else [nn.ReLU()]))
