"""The edge where unchecked bytes become pictures; inside, nobody checks again."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from service.errors import ImageSizeError, UnsupportedFormatError
from service.geometry.camera import PinholeCamera
from service.imaging.depth_formats import DepthEncoding, opencv_decode, read_depth_values
from service.imaging.depth_units import CARLA_SCALE_M, INTEGER_SCALE_M, DepthKind, depth_from_values
from service.imaging.picture_headers import (
    DEFAULT_LIMITS,
    ImageLimits,
    damaged,
    format_of,
    header_of,
    require_bytes,
    require_pixels,
)

__all__ = ["DepthEncoding", "DepthKind", "ImageLimits", "decode_depth", "decode_rgb", "require_sizes"]

Rgb = UInt8[NDArray[np.uint8], "H W 3"]
Depth = Float32[NDArray[np.float32], "H W"]

#: How far the aspect ratio of a picture may lie from the camera's: rounding when resizing, not cropping.
ASPECT_TOLERANCE = 0.01
_RGB_FORMATS = ("JPEG", "PNG", "WebP")
#: OpenCV's flags for a part of the size; the bit that says RGB goes with each.
_REDUCED = {1: 0, 2: 16, 4: 32, 8: 64}


def decode_rgb(
    data: bytes, *, limits: ImageLimits = DEFAULT_LIMITS, camera: PinholeCamera | None = None, finest_rad: float = 0.0
) -> Rgb:
    """Decode a colour picture: JPEG, PNG or WebP, in the stored orientation (an EXIF rotation is not applied).

    Grey pictures get three equal channels, alpha is dropped, 16 bits become 8.

    Args:
        data: the encoded picture.
        limits: what it may cost.
        camera: whose picture it is, at any scale.
        finest_rad: a JPEG whose pixels are finer is decoded at a half, a quarter or an eighth of its size, as long as
            its pixels stay finer; the decoder then leaves out the work, and pixels are means instead of samples.

    Raises:
        DecodeError: the bytes are damaged, cut off or missing.
        UnsupportedFormatError: another format.
        TooLargeError: more bytes, or by its header more pixels, than the limits allow.
    """
    field = "rgb"
    require_bytes(data, limits, field=field)
    format_ = format_of(data, field=field)
    if format_ not in _RGB_FORMATS:
        raise UnsupportedFormatError(
            f"The part `{field}` is {format_}, which is not read as colour; send JPEG, PNG or WebP.", field=field
        )
    header = header_of(data, format_, field=field)
    require_pixels(header.height, header.width, limits, field=field)
    by = _reduction(header.width, camera, finest_rad) if format_ == "JPEG" and camera is not None else 1
    rgb = opencv_decode(data, cv2.IMREAD_COLOR_RGB | _REDUCED[by] | cv2.IMREAD_IGNORE_ORIENTATION, field=field)
    if rgb.shape != (-(-header.height // by), -(-header.width // by), 3):
        raise damaged(field, f"its pixels are {rgb.shape}, its header says {header.height}x{header.width}")
    return rgb.astype(np.uint8, copy=False)


def _reduction(width: int, camera: PinholeCamera, finest_rad: float) -> int:
    focal_px = camera.fx * width / camera.width
    return next((by for by in (8, 4, 2) if by <= finest_rad * focal_px), 1)


def decode_depth(
    data: bytes,
    *,
    camera: PinholeCamera,
    encoding: DepthEncoding | None = None,
    scale_m: float | None = None,
    kind: DepthKind = "z",
    baseline_m: float | None = None,
    max_range_m: float | None = None,
    limits: ImageLimits = DEFAULT_LIMITS,
) -> Depth:
    """Decode a depth picture (formats: see ``read_depth_values``) to metres along the optical axis.

    Args:
        data: the encoded picture.
        camera: the camera whose request this is; the picture may be a uniformly resized one of its.
        encoding: ``carla`` for CARLA's 24-bit PNG, ``compressed_depth`` for the data of ROS' compressedDepth; auto or None tell by
            the first bytes.
        scale_m: metres (disparity: pixels) for each stored unit, obeyed in every format. Where it is None, the format
            decides: 0.001 for 16-bit integers, 1 for floating values, and for CARLA 1000 m for all 24 bits.
        kind: what is stored: z, range along the ray, or disparity.
        baseline_m: metres between the two cameras; needed for disparity.
        max_range_m: what lies beyond is no measurement.
        limits: what the picture may cost.

    Returns:
        z, metres; 0 where nothing was measured (0, negative, NaN and infinite values).

    Raises:
        DecodeError: the bytes are damaged, cut off or missing.
        UnsupportedFormatError: another format or sample type.
        TooLargeError: more bytes, or by its header more pixels, than the limits allow.
        RequestError: scale, baseline or limit is missing or not positive.
    """
    values = read_depth_values(data, encoding=encoding, limits=limits)
    if scale_m is None:
        integer_scale = CARLA_SCALE_M if encoding == "carla" else INTEGER_SCALE_M
        scale_m = integer_scale if np.issubdtype(values.dtype, np.integer) else 1.0
    return depth_from_values(
        values, scale_m=scale_m, kind=kind, camera=camera, baseline_m=baseline_m, max_range_m=max_range_m
    )


def require_sizes(
    rgb: UInt8[NDArray[np.uint8], "H W 3"], depth_m: Float32[NDArray[np.float32], "h w"], camera: PinholeCamera
) -> None:
    """Refuse pictures that are not the camera's, each at any uniform scale of its own.

    Raises:
        ImageSizeError: an aspect ratio is more than 1 % off the camera's.
    """
    for field, picture in (("rgb", rgb), ("depth", depth_m)):
        height, width = picture.shape[:2]
        if abs(width * camera.height - height * camera.width) > ASPECT_TOLERANCE * height * camera.width:
            raise ImageSizeError(
                f"The picture `{field}` has {width}x{height} pixels, which is not the camera's {camera.width}x"
                f"{camera.height} at any scale; send the whole picture, or the intrinsics of the picture sent.",
                field=field,
            )
