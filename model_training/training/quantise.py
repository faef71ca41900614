"""Quantise an encoder to eight bits: a quarter of the bytes, less than half of the time, nearly the same descriptors.

Weights are integers with one scale per filter, activations with one scale per tensor (Jacob et al., CVPR 2018).
The normalisation at the start and the unit vector at the end stay float32.
Weights use only seven bits. On processors without VNNI the sum of two eight-bit products would overflow 16 bits.
Then descriptors would depend on the processor.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quant_pre_process, quantize_static

from service.errors import EncoderError
from service.retrieval.encoder import Descriptors, Encoder

#: ONNX operators that are quantised.
QUANTISED = ("Conv", "Gemm", "MatMul", "Add", "Relu")
#: Least cosine between the two descriptors of a view: the mean, and the 1 % quantile over all views.
LEAST_MEAN, LEAST_OF_HUNDRED = 0.999, 0.998

Planes = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Views:
    """Views of queries and of the survey.

    Attributes:
        planes: (B, 6, rows, columns); queries come first.
        queries: number of query views.
    """

    planes: Planes
    queries: int

    @property
    def side(self) -> NDArray[np.float32]:
        """1 for queries, 0 for survey views (B,)."""
        return (np.arange(len(self.planes)) < self.queries).astype(np.float32)

    def encoded(self, encoder: Encoder) -> Descriptors:
        """Return the descriptors (B, D) of all views.

        Args:
            encoder: encodes the views.
        """
        split = self.queries
        found: Descriptors = np.concatenate(
            [encoder.encode(self.planes[:split], "query"), encoder.encode(self.planes[split:], "survey")]
        )
        return found


@dataclass(frozen=True, slots=True)
class Agreement:
    """Cosines between float32 and eight-bit descriptors, over views that did not set the ranges.

    Attributes:
        mean: mean cosine.
        of_hundred: 1 % quantile of the cosine.
        views: number of views.
    """

    mean: float
    of_hundred: float
    views: int


def quantise(encoder: Path, out: Path, ranges: Iterable[Views], checks: Iterable[Views]) -> Agreement:
    """Write an encoder in eight bits, and check that its descriptors are nearly the same.

    Args:
        encoder: ONNX file that ``export`` wrote.
        out: file to write; renamed when it is complete.
        ranges: views of training cities that set the ranges of the activations.
        checks: other views, for the check.

    Raises:
        EncoderError: the encoder cannot be read or already has eight bits, or the descriptors differ by more than
            ``LEAST_MEAN`` and ``LEAST_OF_HUNDRED`` allow; nothing is written.
    """
    before = Encoder.open(encoder)
    model = onnx.load(encoder)
    if any(node.op_type == "QuantizeLinear" for node in model.graph.node):
        raise EncoderError(f"{encoder} already has 8 bits; give the file that `streetfix export` wrote")
    data = _in_eight_bits(encoder, model, ranges)
    after, cosines = Encoder.open(data), list[NDArray[np.float32]]()
    for views in checks:
        cosines.append((views.encoded(before) * views.encoded(after)).sum(axis=1))
    found = np.concatenate(cosines)
    agreement = Agreement(float(found.mean()), float(np.quantile(found, 0.01)), len(found))
    if agreement.mean < LEAST_MEAN or agreement.of_hundred < LEAST_OF_HUNDRED:
        raise EncoderError(
            f"8-bit descriptors differ too much: mean cosine {agreement.mean:.4f} (at least {LEAST_MEAN}), 1st "
            f"percentile {agreement.of_hundred:.4f} (at least {LEAST_OF_HUNDRED}); nothing was written"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(out.name + ".part")
    part.write_bytes(data)
    part.rename(out)
    return agreement


def _in_eight_bits(encoder: Path, model: onnx.ModelProto, ranges: Iterable[Views]) -> bytes:
    class Reader(CalibrationDataReader):  # type: ignore[misc]  # the package is not typed
        def __init__(self) -> None:
            self._views = iter(ranges)

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            views = next(self._views, None)
            return None if views is None else {"planes": views.planes, "side": views.side}

    with tempfile.TemporaryDirectory() as folder:
        plain, whole = Path(folder) / "plain.onnx", Path(folder) / "whole.onnx"
        quant_pre_process(
            str(encoder), str(plain), skip_symbolic_shape=True
        )  # folds constants, which the next step needs
        quantize_static(
            str(plain),
            str(whole),
            Reader(),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            reduce_range=True,
            op_types_to_quantize=list(QUANTISED),
        )
        found = onnx.load(whole)
    metadata = {each.key: each.value for each in model.metadata_props}
    onnx.helper.set_model_props(found, metadata | {"bits": "8"})
    return bytes(found.SerializeToString())
