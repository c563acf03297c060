"""What makes a small network quick on a processor: weights laid out beforehand, pooling by slices.

For one picture of 64 x 64 torch's own layers spend as long on the layout of the weights, anew at
each call, as on the arithmetic. The results are the same, bit for bit.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

Shape = tuple[int, ...]


class PackedConv(nn.Module):
    """A convolution on a processor, for inference: its weights in oneDNN's own layout.

    That layout depends on the input's shape, so there is one for each that comes: not for inputs of
    any number of shapes.
    """

    def __init__(self, conv: nn.Conv2d) -> None:
        super().__init__()
        self.weight, self.bias = conv.weight, conv.bias
        self._geometry = (conv.padding, conv.stride, conv.dilation, conv.groups)
        self._packed: dict[Shape, Tensor] = {}

    def forward(self, x: Tensor) -> Tensor:
        """As nn.Conv2d."""
        shape = tuple(x.shape)
        packed = self._packed.get(shape)
        if packed is None:
            packed = self._packed[shape] = self._pack(shape)
        return torch.ops.mkldnn._convolution_pointwise(
            x, packed, self.bias, *self._geometry, "none", [], ""
        )

    def _pack(self, shape: Shape) -> Tensor:
        weight = self.weight.contiguous()
        return torch.ops.mkldnn._reorder_convolution_weight(weight, *self._geometry, shape)


class HalvingPool(nn.Module):
    """MaxPool2d(2) of even sizes, which is twice as slow on pictures of few channels."""

    def forward(self, x: Tensor) -> Tensor:
        """As nn.MaxPool2d(2)."""
        rows = torch.maximum(x[:, :, ::2], x[:, :, 1::2])
        return torch.maximum(rows[..., ::2], rows[..., 1::2])


def pack(network: nn.Module) -> nn.Module:
    """Make the network quick, in place, where oneDNN knows the processor."""
    if torch.backends.mkldnn.is_available():
        for name, layer in network.named_children():
            setattr(network, name, _packed(layer))
    return network


def _packed(layer: nn.Module) -> nn.Module:
    if isinstance(layer, nn.Conv2d):
        return PackedConv(layer)
    if isinstance(layer, nn.MaxPool2d) and layer.kernel_size == (2, 2):
        return HalvingPool()
    return pack(layer)
