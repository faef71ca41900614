"""Export an encoder to ONNX: one file, dynamic batch size, normalisation inside, checked against torch."""

import io
from pathlib import Path

import numpy as np
import onnx
import torch

from model_training.training.encoder_net import EncoderNet
from service.errors import EncoderError
from service.imaging.view_grid import PLANES
from service.retrieval.encoder import Encoder

#: Greatest difference of a descriptor's component between torch and ONNX Runtime.
TOLERANCE = 1e-4


def export(net: EncoderNet, out: Path, *, trained_on: tuple[str, ...] = ()) -> float:
    """Write an encoder as ONNX, and check that it gives the same descriptors.

    Args:
        net: the encoder; left in evaluation mode.
        out: file to write; renamed when it is complete.
        trained_on: cities of the training set. They are kept in the file, so that an evaluation can name its split.

    Returns:
        The greatest difference of a descriptor's component between torch and ONNX Runtime.

    Raises:
        EncoderError: that difference exceeds ``TOLERANCE`` or is no number; nothing is written.
    """
    net.eval()
    shape = net.shape
    example = (torch.rand(2, len(PLANES), shape.rows, shape.columns) * 20, torch.tensor([0.0, 1.0]))
    buffer = io.BytesIO()
    with torch.no_grad():
        torch.onnx.export(
            net,
            example,
            buffer,  # type: ignore[arg-type]  # the tracing exporter writes to buffers too
            input_names=["planes", "side"],
            output_names=["descriptor"],
            opset_version=17,
            dynamo=False,
            dynamic_axes={"planes": {0: "batch"}, "side": {0: "batch"}, "descriptor": {0: "batch"}},
        )
    net.eval()  # the tracing exporter leaves the module in training mode
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {"trained_on": " ".join(trained_on)})
    data = bytes(model.SerializeToString())
    difference = _difference(net, Encoder.open(data))
    if not difference <= TOLERANCE:  # also refuses NaN
        raise EncoderError(f"ONNX and torch differ by {difference:.2e}, more than {TOLERANCE:.0e}; nothing was written")
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(out.name + ".part")
    part.write_bytes(data)
    part.rename(out)
    return difference


def _difference(net: EncoderNet, encoder: Encoder) -> float:
    """Greatest difference over views with gaps, of both sides, in a batch of another size than the traced one."""
    rng = np.random.default_rng(0)
    planes = rng.uniform(0, 40, (7, len(PLANES), net.shape.rows, net.shape.columns)).astype(np.float32)
    planes[:, 0] *= rng.random(planes[:, 0].shape) > 0.3
    differences = []
    for side, flag in (("survey", 0.0), ("query", 1.0)):
        with torch.no_grad():
            expected = net(torch.from_numpy(planes), torch.full((len(planes),), flag)).numpy()
        found = encoder.encode(planes, "survey" if side == "survey" else "query")
        differences.append(np.abs(expected - found).max())
    return float(np.max(differences))  # NaN if one of them is, which ``max`` would hide
