"""The autoencoder as inference runs it: every BatchNorm folded into its convolution."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from koop_service.encoding.autoencoder import Autoencoder, Size


def fold(model: Autoencoder) -> tuple[nn.Module, nn.Module]:
    """(encoder, decoder) equal to `model` in evaluation mode, up to rounding, without BatchNorm."""
    encoder = nn.Sequential(*(_fold_encoder_block(block) for block in model.encoder))
    decoder = nn.Sequential(*(_fold_decoder_block(block) for block in model.decoder))
    for part in (encoder, decoder):
        part.eval().requires_grad_(False)
    return encoder, decoder


class SignedPool(nn.Module):
    """Max-pooling of channels whose normalisation had a negative scale: the sign acts after it."""

    def __init__(self, pool: nn.Module, sign: Tensor, shift: Tensor) -> None:
        super().__init__()
        self.pool = pool
        self.sign = nn.Parameter(sign[:, None, None])
        self.shift = nn.Parameter(shift[:, None, None])

    def forward(self, x: Tensor) -> Tensor:
        return self.pool(x) * self.sign + self.shift


def _fold_encoder_block(block: nn.Module) -> nn.Module:
    conv, pool, norm, *activation = block.children()
    conv = cast("nn.Conv2d", conv)
    scale, shift = _affine(cast("nn.BatchNorm2d", norm))
    bias = cast("Tensor", conv.bias).detach()
    folded = nn.Conv2d(conv.in_channels, conv.out_channels, 3, padding=1)
    folded.weight = nn.Parameter(conv.weight.detach() * scale.abs()[:, None, None, None])
    if bool((scale >= 0).all()):
        folded.bias = nn.Parameter(bias * scale + shift)
        return nn.Sequential(folded, pool, *activation)
    # max(s x) = s max(x) only for s >= 0.
    folded.bias = nn.Parameter(bias * scale.abs())
    return nn.Sequential(folded, SignedPool(pool, scale.sign(), shift), *activation)


def _fold_decoder_block(block: nn.Module) -> nn.Module:
    conv, norm, *activation = block.children()
    conv = cast("nn.ConvTranspose2d", conv)
    scale, shift = _affine(cast("nn.BatchNorm2d", norm))
    folded = nn.ConvTranspose2d(
        conv.in_channels,
        conv.out_channels,
        cast("Size", conv.kernel_size),
        cast("Size", conv.stride),
        cast("Size", conv.padding),
    )
    folded.weight = nn.Parameter(conv.weight.detach() * scale[None, :, None, None])
    folded.bias = nn.Parameter(cast("Tensor", conv.bias).detach() * scale + shift)
    return nn.Sequential(folded, *activation)


def _affine(norm: nn.BatchNorm2d) -> tuple[Tensor, Tensor]:
    """BatchNorm in evaluation mode is x -> scale x + shift."""
    mean, variance = cast("Tensor", norm.running_mean), cast("Tensor", norm.running_var)
    scale = norm.weight.detach() / torch.sqrt(variance + norm.eps)
    return scale, norm.bias.detach() - mean * scale
