"""Encode NumPy images in formats that the service decodes at low cost: depth as raw16+zstd, colour as JPEG.

The tables give processor time of one core and size for a simulated query of 640 x 480 pixels. All values are ratios to the
formats that drivers of RGB-D cameras write: 16-bit PNG for depth and PNG for colour.

==================  ======  =======  =====
depth               encode  decode   bytes
==================  ======  =======  =====
16-bit PNG          1       1        1
raw16+zstd          0.33    0.46     0.87
raw16+lz4           0.22    0.32     1.06
NPY of uint16       0.01    0.03     2.8
NPY of float32      0.02    0.02     5.5
==================  ======  =======  =====

==================  ======  =======  =====
colour              encode  decode   bytes
==================  ======  =======  =====
PNG                 1       1        1
JPEG, quality 90    0.08    0.22     0.16
JPEG, quality 95    0.09    0.25     0.22
==================  ======  =======  =====

NPY decodes faster, but its body is three times as long. Reading the body costs the service more than the decoding saves.
A whole request without registration needs 1.04 times the processor time with NPY (on loopback).

Pillow encodes the colour image, not OpenCV: the client alone then takes 107 MiB instead of 240 (decision 0143). The JPEG files are equal
byte for byte. Pillow takes 2.5 times as long as OpenCV for a PNG. A client that is given encoded images imports neither Pillow nor
zstandard.
"""

import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import RequestError, extra_missing
from service.imaging.depth_unit_hint import MILLIMETRE_FACTOR, unit_factor
from service.imaging.raw16 import Codec, write_raw16

#: Default JPEG quality. Images larger by 3 % of the PNG size do not change an answer.
JPEG_QUALITY = 90
_MOST_STORED = 65535
#: Step sizes for depth in metres, mm. The encoder uses the finest step that can store the farthest measurement.
_STEPS_MM = range(1, 11)
#: Largest depth that the coarsest step can store, metres. No depth camera measures more, so larger values are dropped.
FARTHEST_M = 1e-3 * _STEPS_MM[-1] * _MOST_STORED


@dataclass(frozen=True, slots=True)
class EncodedDepth:
    """An encoded depth image.

    Attributes:
        data: raw16, or NPY if floating-point values are sent unchanged.
        scale_m: metres (disparity: pixels) per stored unit. The request must contain it.
    """

    data: bytes
    scale_m: float


@dataclass(frozen=True, slots=True)
class Packing:
    """How images are encoded.

    Attributes:
        quality: JPEG quality of the colour image, 1 to 100. None sends PNG.
        depth_codec: codec of the raw16 depth image.
    """

    quality: int | None = JPEG_QUALITY
    depth_codec: Codec = "zstd"


def encode_rgb(rgb: NDArray[np.uint8], *, quality: int | None = JPEG_QUALITY) -> bytes:
    """Encode a colour image as JPEG or PNG.

    Args:
        rgb: (H, W, 3), sRGB.
        quality: JPEG quality, 1 to 100. None encodes a lossless PNG, which costs the service five times as much to decode.

    Raises:
        RequestError: the array is no colour image, or the quality is out of bounds.
        ExtraMissingError: Pillow is not installed.
    """
    if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or not rgb.size:
        raise RequestError(
            f"rgb: must be uint8 (H, W, 3), not {_described(rgb)}; pass such an array, or the bytes of an image file",
            field="rgb",
        )
    if quality is not None and not 1 <= quality <= 100:
        raise RequestError(
            f"quality: {quality} is not a valid JPEG quality; pass 1 to 100, or None for PNG", field="quality"
        )
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise extra_missing("an rgb array", None, error) from error
    stream = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(rgb))
    if quality is None:
        image.save(stream, "PNG", compress_level=1)
    else:
        image.save(stream, "JPEG", quality=quality)
    return stream.getvalue()


def encode_depth(depth: NDArray[Any], *, scale_m: float | None = None, codec: Codec = "zstd") -> EncodedDepth:
    """Encode a depth image as raw16.

    Floating-point metres are rounded to steps of 1 mm, or up to 10 mm if the farthest measurement needs it. So the error is
    at most half a step.

    Args:
        depth: (H, W), floating-point values or uint16. 0, negative, NaN and infinite values mean "no measurement".
        scale_m: metres (disparity: pixels) per unit of ``depth``. The default is 0.001 for integers and 1 for floating-point
            values. Floating-point values with an explicit scale are sent unchanged as NPY.
        codec: ``zstd`` or ``lz4``. lz4 needs a quarter more bytes, and three fifths of the time to decode.

    Raises:
        RequestError: the array is no depth image, its metres look like millimetres, or the scale is not positive.
    """
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or not depth.size or depth.dtype.str[1:] not in _DTYPES:
        raise RequestError(
            f"depth: must be a float or uint16 array (H, W), not {_described(depth)}; "
            "pass metres as float32, or the bytes of an image file",
            field="depth",
        )
    if scale_m is not None and not (math.isfinite(scale_m) and scale_m > 0):
        raise RequestError(
            f"depth_scale_m: {scale_m} is not a valid scale; pass metres per unit, such as 0.001", field="depth_scale_m"
        )
    if depth.dtype.kind == "u":  # of either byte order, as a file may have it
        return EncodedDepth(write_raw16(depth, codec), 0.001 if scale_m is None else scale_m)
    if scale_m is not None:
        return EncodedDepth(_npy(depth), scale_m)
    stored, step_m = _in_steps(depth)
    return EncodedDepth(write_raw16(stored, codec), step_m)


_DTYPES = frozenset({"f2", "f4", "f8", "u2"})


def _in_steps(depth_m: NDArray[Any]) -> tuple[NDArray[np.uint16], float]:
    """Round metres to the finest possible step. Return the (H, W) numbers of steps and the step, metres."""
    metres = depth_m.astype(np.float32, copy=False)
    if (metres > FARTHEST_M).any() and unit_factor(metres) == MILLIMETRE_FACTOR:
        median = float(np.median(metres[np.isfinite(metres) & (metres > 0)]))
        raise RequestError(
            f"depth: the median is {median:.4g} m, which looks like millimetres; pass depth_scale_m=0.001, or divide by 1000",
            field="depth",
        )
    with np.errstate(invalid="ignore"):
        measured = (metres > 0) & (metres <= FARTHEST_M)
    metres = np.where(measured, metres, np.float32(0))
    farthest_mm = 1e3 * float(metres.max())
    step_m = 1e-3 * next(
        step for step in _STEPS_MM if farthest_mm <= step * _MOST_STORED + 0.5 or step == _STEPS_MM[-1]
    )
    return np.minimum(np.rint(metres / np.float32(step_m)), _MOST_STORED).astype(np.uint16), step_m


def _npy(values: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.ascontiguousarray(values), allow_pickle=False)
    return stream.getvalue()


def _described(given: object) -> str:
    return f"{given.dtype} {given.shape}" if isinstance(given, np.ndarray) else f"a {type(given).__name__}"
