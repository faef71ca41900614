"""Rebuild the trainable network from an exported encoder.

An encoder in a map bundle or in the package has no checkpoint.
Export folds batch normalisation into the convolutions. Eight-bit quantisation rounds their weights.
Here each convolution takes the folded weights. The statistics of its normalisation are set from views.
Then the layer gives the same output as the exported layer, in training mode and in evaluation mode.
"""

from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor, nn

from model_training.training.encoder_net import EncoderNet, EncoderShape
from service.errors import EncoderError
from service.retrieval.encoder import Encoder

Floats = NDArray[np.float32]


def net_of(encoder: Path, shape: EncoderShape, planes: Tensor, side: Tensor) -> EncoderNet:
    """Read an encoder that ``export`` or ``quantise`` wrote.

    Args:
        encoder: ONNX file.
        shape: shape that the encoder must have.
        planes: views (B, 6, rows, columns) that set the statistics of batch normalisation; several hundred of both sides.
        side: 0 for survey views, 1 for queries (B).

    Raises:
        EncoderError: the file is no encoder of this architecture and shape.
    """
    layers = require_shape(encoder, shape)
    net = EncoderNet(shape)
    convolutions = [module for module in net.modules() if isinstance(module, nn.Conv2d | nn.Linear)]
    blocks = [module for module in net.modules() if isinstance(module, nn.Sequential)]
    biases: dict[nn.Module, Tensor] = {}
    for module, (weight, bias) in zip(convolutions, layers, strict=True):
        if module.weight.shape != weight.shape:
            raise _foreign(
                encoder, f"a layer has the shape {tuple(weight.shape)}, expected {tuple(module.weight.shape)}"
            )
        module.weight.data.copy_(torch.from_numpy(weight))
        if module.bias is not None:
            module.bias.data.copy_(torch.from_numpy(bias))
        else:
            biases[module] = torch.from_numpy(bias)
    hooks = [_norm(block).register_forward_pre_hook(_matching(biases[block[0]])) for block in blocks]
    net.eval()
    with torch.no_grad():  # the hooks run front to back: each layer is set before the next one gets its input
        net(planes, side)
    for hook in hooks:
        hook.remove()
    return net


def require_shape(encoder: Path, shape: EncoderShape) -> list[tuple[Floats, Floats]]:
    """Read weight and bias of every layer, and check the encoder's shape.

    Args:
        encoder: ONNX file.
        shape: shape that the encoder must have.

    Returns:
        Weight and bias of the twelve layers, in order.

    Raises:
        EncoderError: the file is no encoder of this architecture and shape.
    """
    try:
        opened = Encoder.open(encoder)
    except EncoderError as error:  # its text may not name the file
        raise EncoderError(f"{encoder}: {error}", field="encoder") from error
    layers = _layers(encoder)
    found = _shape(opened, layers, encoder)
    if found != shape:
        raise EncoderError(
            f"{encoder}: it has the shape {found}, but the training expects {shape}; start from an encoder of that "
            "shape",
            field="encoder",
        )
    return layers


def _matching(bias: Tensor):  # type: ignore[no-untyped-def]  # torch's hook type is private
    """Make a hook that sets a normalisation so that it only adds ``bias`` to its input."""

    def hook(norm: nn.BatchNorm2d, inputs: tuple[Tensor]) -> None:
        mean, variance = inputs[0].mean(dim=(0, 2, 3)), inputs[0].var(dim=(0, 2, 3))
        for known, value in (
            (norm.running_mean, mean),
            (norm.running_var, variance),
            (norm.weight, torch.sqrt(variance + norm.eps)),
            (norm.bias, bias + mean),
        ):
            if known is None:
                raise TypeError("the normalisation has no running statistics")
            known.data.copy_(value)

    return hook


def _norm(block: nn.Sequential) -> nn.BatchNorm2d:
    norm = block[1]
    if not isinstance(norm, nn.BatchNorm2d):
        raise TypeError(f"{norm} is not a batch normalisation")
    return norm


def _layers(encoder: Path) -> list[tuple[Floats, Floats]]:
    """Read weight and bias of every layer that has weights, in order, as float32."""
    graph = onnx.load(encoder).graph
    known = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    for node in graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] in known:
            if any(name not in known for name in node.input):
                raise _foreign(encoder, f"{node.name} has no constant scale")
            parts = [known[name] for name in node.input]
            values, scale, zero = (*parts, np.zeros(1)) if len(parts) == 2 else parts
            along = (-1,) + (1,) * (values.ndim - 1) if scale.ndim else ()
            known[node.output[0]] = (
                (values.astype(np.float32) - zero.astype(np.float32).reshape(along if zero.size > 1 else ()))
                * scale.reshape(along)
            ).astype(np.float32)
        elif node.op_type == "Identity" and node.input[0] in known:  # torch stores equal tensors only once
            known[node.output[0]] = known[node.input[0]]
    found = []
    for node in graph.node:
        if node.op_type in ("Conv", "Gemm"):
            if any(name not in known for name in node.input[1:3]) or len(node.input) != 3:
                raise _foreign(encoder, f"{node.name} has no constant weights and bias")
            weight, bias = (known[name].astype(np.float32) for name in node.input[1:3])
            found.append((weight, bias))
    return found


def _shape(encoder: Encoder, layers: list[tuple[Floats, Floats]], path: Path) -> EncoderShape:
    if len(layers) != 12:
        raise _foreign(path, f"it has {len(layers)} layers with weights, not 12")
    outputs = [len(bias) for _, bias in layers]
    return EncoderShape(
        rows=encoder.rows,
        columns=encoder.columns,
        widths=(outputs[0], outputs[1], outputs[6], outputs[9]),
        narrow=outputs[10],
        descriptor=outputs[11],
    )


def _foreign(path: Path, why: str) -> EncoderError:
    return EncoderError(
        f"training cannot start from {path}: {why}; give an encoder that `streetfix export` wrote", field="encoder"
    )
