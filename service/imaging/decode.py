"""Decode and check the images of a request.

Unchecked bytes enter here. Code behind this module relies on these checks and does not repeat them.
"""

from typing import Any

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

__all__ = [
    "DepthEncoding",
    "DepthKind",
    "ImageLimits",
    "decode_depth",
    "decode_rgb",
    "default_scale_m",
    "require_sizes",
    "stored_size",
]

Rgb = UInt8[NDArray[np.uint8], "H W 3"]
Depth = Float32[NDArray[np.float32], "H W"]

#: Largest relative difference between the aspect ratios of image and camera. It allows for rounding after resizing, not for
#: cropping.
ASPECT_TOLERANCE = 0.01
_RGB_FORMATS = ("JPEG", "PNG", "WebP")
#: OpenCV flag bits that decode a JPEG at 1 / divisor of its size. Each is combined with the flag for RGB order.
_REDUCED = {1: 0, 2: 16, 4: 32, 8: 64}


def decode_rgb(
    data: bytes, *, limits: ImageLimits = DEFAULT_LIMITS, camera: PinholeCamera | None = None, finest_rad: float = 0.0
) -> Rgb:
    """Decode a colour image (JPEG, PNG or WebP) in its stored orientation.

    An EXIF rotation is not applied. Grey images get three equal channels. Alpha is dropped. 16 bits become 8.

    Args:
        data: bytes of the encoded image.
        limits: largest number of bytes and pixels.
        camera: camera of the image, at any scale. None: always decode at full size.
        finest_rad: angle between the rays that the caller samples, radians. A JPEG is decoded at 1/2, 1/4 or 1/8 of its size
            if its pixels then still cover no more than this angle. This saves time, and pixels become means instead of samples.

    Raises:
        DecodeError: the bytes are damaged, cut off or missing.
        UnsupportedFormatError: the format is not JPEG, PNG or WebP.
        TooLargeError: the image has more bytes, or by its header more pixels, than the limits allow.
    """
    field = "rgb"
    require_bytes(data, limits, field=field)
    format_ = format_of(data, field=field)
    if format_ not in _RGB_FORMATS:
        raise UnsupportedFormatError(
            f"The part `{field}` is {format_}, which is not supported for colour; send JPEG, PNG or WebP.", field=field
        )
    header = header_of(data, format_, field=field)
    require_pixels(header.height, header.width, limits, field=field)
    by = _reduction(header.width, camera, finest_rad) if format_ == "JPEG" and camera is not None else 1
    rgb = opencv_decode(data, cv2.IMREAD_COLOR_RGB | _REDUCED[by] | cv2.IMREAD_IGNORE_ORIENTATION, field=field)
    if rgb.shape != (-(-header.height // by), -(-header.width // by), 3):
        raise damaged(field, f"the decoded shape is {rgb.shape}, but the header states {header.height}x{header.width}")
    return rgb.astype(np.uint8, copy=False)


def stored_size(data: bytes, *, field: str = "rgb") -> tuple[int, int]:
    """Read the size of an encoded image from its header.

    ``decode_rgb`` may decode a JPEG at a fraction of this size.

    Args:
        data: bytes of a JPEG, PNG, WebP or TIFF.
        field: part of the request that errors name.

    Returns:
        Height and width, pixels.

    Raises:
        DecodeError: the header is damaged, or the file is cut off.
        UnsupportedFormatError: the format is unknown.
    """
    header = header_of(data, format_of(data, field=field), field=field)
    return header.height, header.width


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
    """Decode a depth image to metres along the optical axis.

    ``read_depth_values`` lists the formats.

    Args:
        data: bytes of the encoded image.
        camera: camera of the request. The image may be a uniformly resized one of this camera.
        encoding: ``carla`` for the 24-bit PNG of CARLA, ``compressed_depth`` for the data of ROS compressedDepth.
            ``auto`` or None: the first bytes decide.
        scale_m: metres (disparity: pixels) per stored unit, used for every format. None: the format decides. It is 0.001 for
            integers, 1 for floating values, and 1000 / (2^24 - 1) for CARLA (far plane at 1000 m).
        kind: stored quantity: z, range along the ray, or disparity.
        baseline_m: distance between the two cameras, metres. Disparity needs it.
        max_range_m: limit of the sensor, metres. Values beyond it count as not measured.
        limits: largest number of bytes and pixels.

    Returns:
        Depth z in metres. 0 means "not measured" (stored values that are 0, negative, NaN or infinite).

    Raises:
        DecodeError: the bytes are damaged, cut off or missing.
        UnsupportedFormatError: the format or the sample type is not read as depth.
        TooLargeError: the image has more bytes, or by its header more pixels, than the limits allow.
        RequestError: the scale, the baseline or the limit is missing or not positive.
    """
    values = read_depth_values(data, encoding=encoding, limits=limits)
    if scale_m is None:
        scale_m = default_scale_m(values.dtype, encoding)
    return depth_from_values(
        values, scale_m=scale_m, kind=kind, camera=camera, baseline_m=baseline_m, max_range_m=max_range_m
    )


def default_scale_m(stored: np.dtype[Any], encoding: DepthEncoding | None) -> float:
    """Return the scale of a depth image if the request names none, metres (disparity: pixels) per stored unit.

    Args:
        stored: type of the stored values.
        encoding: of the request.
    """
    if not np.issubdtype(stored, np.integer):
        return 1.0
    return CARLA_SCALE_M if encoding == "carla" else INTEGER_SCALE_M


def require_sizes(
    rgb: UInt8[NDArray[np.uint8], "H W 3"],
    depth_m: Float32[NDArray[np.float32], "h w"],
    camera: PinholeCamera,
    *,
    rgb_size: tuple[int, int] | None = None,
) -> None:
    """Refuse images whose aspect ratio is not that of the camera.

    Each image may have a uniform scale of its own.

    Args:
        rgb: colour image, sRGB.
        depth_m: depth z, metres.
        camera: camera of the request, pixels.
        rgb_size: height and width of the encoded colour image, pixels, if it may have been decoded at a fraction of its size.
            None takes those of ``rgb``.

    Raises:
        ImageSizeError: an aspect ratio differs from that of the camera by more than 1 %.
    """
    sizes = (("rgb", rgb.shape[:2] if rgb_size is None else rgb_size), ("depth", depth_m.shape))
    for field, (height, width) in sizes:
        if abs(width * camera.height - height * camera.width) > ASPECT_TOLERANCE * height * camera.width:
            raise ImageSizeError(
                f"The image `{field}` has {width}x{height} pixels, but the camera has {camera.width}x{camera.height}, so the "
                "aspect ratios differ; send the whole image, or the intrinsics of the image that you sent.",
                field=field,
            )
