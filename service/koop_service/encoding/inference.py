"""Networks as inference runs them: on a processor by ONNX Runtime, elsewhere by torch.

For pictures of 64 x 64 torch's own layers on a processor take three to five times as long, and give
the interpreter away between any two of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from koop_service.encoding.folding import SignedPool

Network = Callable[[NDArray[Any]], NDArray[np.float32]]
"""(B, C, H, W) -> (B, ...); uint8 means 255ths."""

_OPSET, _IR = 17, 8
"""Of the format; old enough for every ONNX Runtime that pyproject.toml allows."""


def prepare(network: nn.Module, inputs: tuple[int, int, int], device: torch.device) -> Network:
    """`network`, made of folded layers, on a device, for inputs of this (C, H, W)."""
    if device.type == "cpu":
        return _by_onnxruntime(network, inputs)
    return _by_torch(network, device)


def computed_by(device: torch.device) -> str:
    """What `prepare` leaves the arithmetic to; another one may round differently."""
    library = onnxruntime if device.type == "cpu" else torch
    return f"{library.__name__} {library.__version__} on {device}"


def _by_torch(network: nn.Module, device: torch.device) -> Network:
    placed = network.to(device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def run(inputs: NDArray[Any]) -> NDArray[np.float32]:
        # Not ten bits of mantissa (TF32), which is torch's choice for convolutions.
        exact = torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False)
        with torch.inference_mode(), exact:
            pixels = torch.tensor(inputs).to(device, torch.float32)
            if inputs.dtype == np.uint8:
                pixels.mul_(1 / 255)
            return placed(pixels.contiguous(memory_format=torch.channels_last)).cpu().numpy()

    return run


def _by_onnxruntime(network: nn.Module, inputs: tuple[int, int, int]) -> Network:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(
        _Export(network, inputs).model.SerializeToString(),
        options,
        providers=["CPUExecutionProvider"],
    )

    def run(inputs: NDArray[Any]) -> NDArray[np.float32]:
        pixels = inputs.astype(np.float32, copy=False)
        if inputs.dtype == np.uint8:
            pixels *= np.float32(1 / 255)
        return cast("NDArray[np.float32]", session.run(None, {"inputs": pixels})[0])

    return run


class _Export:
    """A network of folded layers, one after the other, in ONNX's terms."""

    def __init__(self, network: nn.Module, inputs: tuple[int, int, int]) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []
        self._last = "inputs"
        self._add(network)
        graph = helper.make_graph(
            self._nodes,
            "network",
            [helper.make_tensor_value_info("inputs", TensorProto.FLOAT, ["batch", *inputs])],
            [helper.make_tensor_value_info(self._last, TensorProto.FLOAT, None)],
            self._constants,
        )
        opset = helper.make_opsetid("", _OPSET)
        self.model = helper.make_model(graph, opset_imports=[opset], ir_version=_IR)

    def _add(self, layer: nn.Module) -> None:
        match layer:
            case nn.Sequential():
                for part in layer:
                    self._add(part)
            case nn.Conv2d() | nn.ConvTranspose2d():
                self._add_convolution(layer)
            case nn.MaxPool2d():
                size = _pair(layer.kernel_size)
                self._append("MaxPool", kernel_shape=size, strides=size)
            case SignedPool():
                self._add(layer.pool)
                self._append("Mul", layer.sign)
                self._append("Add", layer.shift)
            case nn.ReLU():
                self._append("Relu")
            case _:
                raise TypeError(f"no folded network has a layer {layer}")

    def _add_convolution(self, layer: nn.Conv2d | nn.ConvTranspose2d) -> None:
        self._append(
            "Conv" if isinstance(layer, nn.Conv2d) else "ConvTranspose",
            layer.weight,
            cast("Tensor", layer.bias),
            kernel_shape=_pair(layer.kernel_size),
            strides=_pair(layer.stride),
            pads=2 * _pair(cast("Sequence[int]", layer.padding)),
        )

    def _append(self, operation: str, *constants: Tensor, **attributes: Any) -> None:
        names = [f"constant{len(self._constants) + i}" for i in range(len(constants))]
        for name, constant in zip(names, constants, strict=True):
            values = constant.detach().cpu().contiguous().numpy()
            self._constants.append(numpy_helper.from_array(values, name))
        inputs, self._last = [self._last, *names], f"layer{len(self._nodes)}"
        self._nodes.append(helper.make_node(operation, inputs, [self._last], **attributes))


def _pair(size: int | Sequence[int]) -> list[int]:
    return [size, size] if isinstance(size, int) else list(size)
