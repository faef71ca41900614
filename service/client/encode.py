"""Numpy pictures as the bytes that a service reads with the least work: depth as raw16+zstd, colour as JPEG.

Processor time of one core for a simulated 640 x 480 pair, as ratios to what RGB-D cameras' drivers write, a 16-bit PNG (depth)
and a PNG (colour); the bytes beside them:

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

NPY decodes faster still, but its body is three times as long, and reading it costs a service more than unpacking saves: 1.04 of the
processor time of a whole request without registration, on loopback.
"""

import io
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.errors import RequestError
from service.imaging.raw16 import Codec, write_raw16

#: Best known: three in a hundred of a PNG's bytes more would not change an answer.
JPEG_QUALITY = 90
_MOST_STORED = 65535
#: Metres' depth is stored in steps of so many millimetres, the finest that holds the farthest measurement.
_STEPS_MM = range(1, 11)
#: What is said to lie further away than the coarsest step holds, no depth camera has measured.
FARTHEST_M = 1e-3 * _STEPS_MM[-1] * _MOST_STORED


@dataclass(frozen=True, slots=True)
class EncodedDepth:
    """A depth picture to send.

    Attributes:
        data: raw16; NPY where floating values are sent as they are.
        scale_m: metres (disparity: pixels) for each stored unit, which the request must say.
    """

    data: bytes
    scale_m: float


@dataclass(frozen=True, slots=True)
class Packing:
    """How pictures are sent.

    Attributes:
        quality: of the JPEG that colour is sent as; None sends PNG.
        depth_codec: of raw16.
    """

    quality: int | None = JPEG_QUALITY
    depth_codec: Codec = "zstd"


def encode_rgb(rgb: NDArray[np.uint8], *, quality: int | None = JPEG_QUALITY) -> bytes:
    """A colour picture as JPEG, or as PNG.

    Args:
        rgb: (H, W, 3), sRGB.
        quality: of the JPEG, 1 to 100; None is a PNG, which loses nothing and costs the service five times as much to read.

    Raises:
        RequestError: the array is no colour picture, or the quality is none.
    """
    if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or not rgb.size:
        raise RequestError(f"rgb: {_told(rgb)} is no colour picture; give uint8 (height, width, 3)", field="rgb")
    if quality is not None and not 1 <= quality <= 100:
        raise RequestError(f"quality: {quality} is no JPEG quality; give 1 to 100, or None for PNG", field="quality")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    if quality is None:
        return cv2.imencode(".png", bgr)[1].tobytes()
    return cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()


def encode_depth(depth: NDArray[Any], *, scale_m: float | None = None, codec: Codec = "zstd") -> EncodedDepth:
    """A depth picture as raw16.

    Floating metres become whole steps of 1 mm, or of up to 10 mm where the farthest measurement asks for it; so a value
    is off by half a step at most.

    Args:
        depth: (H, W), floating values or uint16; 0, negative, NaN and infinite mean "no measurement".
        scale_m: metres (disparity: pixels) for each unit of ``depth``: 0.001 for integers where it is None, and 1 for floating
            values. Floating values with a scale of their own are sent as they are, as NPY.
        codec: ``zstd``, or ``lz4``: a fifth more bytes, for two thirds of the time on either side.

    Raises:
        RequestError: the array is no depth picture, or the scale is not positive.
    """
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or not depth.size or depth.dtype.str[1:] not in _DTYPES:
        raise RequestError(
            f"depth: {_told(depth)} is no depth picture; give metres as float32, or uint16, (height, width)", field="depth"
        )  # fmt: skip
    if scale_m is not None and not (math.isfinite(scale_m) and scale_m > 0):
        raise RequestError(
            f"depth_scale_m: {scale_m} is no scale; give metres for each unit, such as 0.001", field="depth_scale_m"
        )
    if depth.dtype == np.uint16:
        return EncodedDepth(write_raw16(depth, codec), 0.001 if scale_m is None else scale_m)
    if scale_m is not None:
        return EncodedDepth(_npy(depth), scale_m)
    stored, step_m = _in_steps(depth)
    return EncodedDepth(write_raw16(stored, codec), step_m)


_DTYPES = frozenset({"f2", "f4", "f8", "u2"})


def _in_steps(depth_m: NDArray[Any]) -> tuple[NDArray[np.uint16], float]:
    """Metres in whole steps, and the metres of a step."""
    metres = depth_m.astype(np.float32, copy=False)
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


def _told(given: object) -> str:
    return f"{given.dtype} {given.shape}" if isinstance(given, np.ndarray) else f"a {type(given).__name__}"
