"""Read ``sensor_msgs/Image``, ``CompressedImage`` and ``CameraInfo``."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from model_training.importing.recording import Depth
from service.bridge.pictures import DEPTHS, LENSES, CameraInfoLike
from service.bridge.rig import baseline_from
from service.errors import StreetfixError
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import COEFFICIENTS
from service.imaging.decode import ImageLimits, decode_rgb
from service.imaging.ros_depth import read_ros_depth

#: By encoding: number of channels, and the channels for red, green and blue. Grey is repeated.
_COLOUR = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
    "8UC3": (3, (2, 1, 0)),
}
_LIMITS = ImageLimits()


def colour_of(message: Any) -> UInt8[NDArray[np.uint8], "H W 3"] | str:
    """Decode the sRGB image of an Image or CompressedImage, or say why that fails.

    Args:
        message: of ROS 1 or 2.
    """
    if hasattr(message, "format"):
        try:
            return decode_rgb(bytes(message.data), limits=_LIMITS)
        except StreetfixError as error:
            return f"cannot be decoded: {error.message}"
    if message.encoding not in _COLOUR:
        return f"unknown encoding {message.encoding[:40]!r} (known: {', '.join(_COLOUR)})"
    channels, taken = _COLOUR[message.encoding]
    pixels = _pixels(message, "u1", channels)
    return pixels if isinstance(pixels, str) else np.ascontiguousarray(pixels[:, :, list(taken)])


def depth_of(message: Any) -> Depth | str:
    """Decode the depth of an Image (16UC1: millimetres, 32FC1: metres; REP-118) or compressedDepth message.

    Args:
        message: of ROS 1 or 2.

    Returns:
        Depth (H, W), uint16 in millimetres or float32 in metres; or the reason why there is none.
    """
    if hasattr(message, "format"):
        if "compressedDepth" not in message.format:
            return f"unknown format {message.format[:40]!r} (known: compressedDepth)"
        try:
            values = read_ros_depth(bytes(message.data), _LIMITS, field="depth")
        except StreetfixError as error:
            return f"cannot be decoded: {error.message}"
        return _as_depth(values)
    if message.encoding not in DEPTHS:
        return f"unknown encoding {message.encoding[:40]!r} (known: {', '.join(DEPTHS)})"
    pixels = _pixels(message, DEPTHS[message.encoding], 1)
    if isinstance(pixels, str):
        return pixels
    return _as_depth(np.ascontiguousarray(pixels[:, :, 0]))


def _as_depth(values: NDArray[Any]) -> Depth:
    return np.asarray(values, np.uint16) if values.dtype == np.uint16 else np.asarray(values, np.float32)


def camera_of(message: Any, *, is_rectified: bool) -> PinholeCamera | str:
    """Read the intrinsics of a CameraInfo and the distortion to remove, or say why there are none.

    Args:
        message: sensor_msgs/CameraInfo, of ROS 1 or 2.
        is_rectified: the images are rectified already. Then P applies to them instead of K and D.
    """
    K = np.asarray(message.K if hasattr(message, "K") else message.k, np.float64).reshape(3, 3)
    P = np.asarray(message.P if hasattr(message, "P") else message.p, np.float64).reshape(3, 4)
    D = np.asarray(message.D if hasattr(message, "D") else message.d, np.float64)
    matrix = P[:, :3] if is_rectified and P[0, 0] > 0 else K
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.isfinite(matrix).all()):
        return "its focal lengths are not positive: the camera is not calibrated"
    model, lens = message.distortion_model, LENSES.get(message.distortion_model)
    if lens is None and D.any() and not is_rectified:
        return f"unknown distortion_model {model[:40]!r} (known: {', '.join(filter(None, LENSES))})"
    camera = PinholeCamera(
        int(message.width),
        int(message.height),
        float(matrix[0, 0]),
        float(matrix[1, 1]),
        float(matrix[0, 2]),
        float(matrix[1, 2]),
    )
    if is_rectified or lens is None or not (D.any() or (lens == "kannala_brandt" and D.size)):
        return camera
    if D.size not in COEFFICIENTS[lens] or not np.isfinite(D).all():
        wanted = " or ".join(str(n) for n in COEFFICIENTS[lens])
        return f"distortion_model {model!r} has {D.size} coefficients; expected {wanted} finite ones"
    return replace(camera, distortion=tuple(D.tolist()), distortion_model=lens)


def baseline_of(message: Any, topic: str) -> float:
    """Read the baseline of a stereo rig from the CameraInfo of its rectified right camera, metres.

    Args:
        message: sensor_msgs/CameraInfo, of ROS 1 or 2.
        topic: of the message; named in errors.

    Raises:
        RequestError: the calibration gives no valid baseline.
    """
    projection = SimpleNamespace(p=message.P if hasattr(message, "P") else message.p)
    return baseline_from(cast(CameraInfoLike, projection), topic)


def _pixels(message: Any, dtype: str, channels: int) -> NDArray[Any] | str:
    """Pixels (H, W, channels) of an Image, in native byte order, without the padding of the rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    size = np.dtype(dtype).itemsize
    if height < 1 or width < 1 or height * width > _LIMITS.max_pixels:
        return f"its size of {width}x{height} pixels is 0, or over the limit"
    if step < width * channels * size or len(message.data) < step * height:
        return f"its data have too few bytes for {width}x{height} {message.encoding}: truncated"
    order = ">" if message.is_bigendian else "<"
    rows: NDArray[Any] = np.ndarray(
        (height, width, channels),
        np.dtype(order + dtype),
        np.ascontiguousarray(message.data).data,
        strides=(step, channels * size, size),
    )
    return rows.astype(np.dtype(dtype), copy=False)
