"""Convert ROS messages to numpy images and a camera.

Any object with the fields of the ROS message is accepted, so both rclpy messages and ``service.bridge.messages`` work.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.camera import PinholeCamera

#: Number of channels, and the OpenCV conversion to RGB; None if the image is RGB already.
_COLOURS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
}
#: Depth encodings of REP 118: unsigned millimetres or floating-point metres. Some drivers call the former mono16.
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


class StampLike(Protocol):
    """Fields of builtin_interfaces/Time."""

    sec: int
    nanosec: int


class HeaderLike(Protocol):
    """Fields of std_msgs/Header."""

    stamp: Any
    frame_id: str


class ImageLike(Protocol):
    """Fields of sensor_msgs/Image."""

    header: Any
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: Any


class CameraInfoLike(Protocol):
    """Fields of sensor_msgs/CameraInfo."""

    header: Any
    height: int
    width: int
    d: Sequence[float]
    k: Sequence[float]
    p: Sequence[float]
    roi: Any


def rgb_from(message: ImageLike, topic: str) -> NDArray[np.uint8]:
    """Convert an RGB image message to an (H, W, 3) sRGB array.

    Args:
        message: the image.
        topic: of the message; named in errors.

    Raises:
        RequestError: the encoding is not supported, or the sizes contradict each other; ``field`` is the topic.
    """
    known = _COLOURS.get(message.encoding)
    if known is None:
        raise _unread(message, topic, _COLOURS)
    channels, to_rgb = known
    pixels = _rows(message, topic, np.dtype(np.uint8), channels)
    if to_rgb is None:
        return pixels
    return cv2.cvtColor(pixels, to_rgb).astype(np.uint8, copy=False)


def depth_from(message: ImageLike, topic: str) -> NDArray[np.float32]:
    """Convert a depth image message to z along the optical axis, (H, W), metres; 0 or NaN where nothing was measured.

    Args:
        message: the image.
        topic: of the message; named in errors.

    Raises:
        RequestError: as for ``rgb_from``.
    """
    known = _DEPTHS.get(message.encoding)
    if known is None:
        raise _unread(message, topic, _DEPTHS)
    dtype = np.dtype(known).newbyteorder(">" if message.is_bigendian else "<")
    values = _rows(message, topic, dtype, 1)[..., 0].astype(np.float32)
    return values if known == "f4" else values * np.float32(0.001)


def camera_from(message: CameraInfoLike, topic: str, *, rectified: bool = False) -> PinholeCamera:
    """Return the rectified camera: from P if it is set, else from K, shifted by the region of interest.

    Args:
        message: calibration of the RGB camera.
        topic: of the message; named in errors.
        rectified: the images are rectified already, although the message has distortion coefficients.

    Raises:
        RequestError: the camera is not calibrated, or the images are not rectified.
    """
    if any(message.d) and not rectified:
        raise RequestError(
            f"{topic}: the lens distorts (d = {[round(each, 4) for each in message.d]}), but the images must be rectified; subscribe to "
            "the rectified topics of image_proc and pass --rectified",
            field=topic,
        )
    p, k = message.p, message.k
    fx, fy, cx, cy = (p[0], p[5], p[2], p[6]) if p[0] else (k[0], k[4], k[2], k[5])
    width, height = message.width, message.height
    if not (fx > 0 and fy > 0 and width > 1 and height > 1):
        raise RequestError(
            f"{topic}: this camera is not calibrated (fx {fx:g}, fy {fy:g}, {width}x{height}); calibrate it, or change --info-topic",
            field=topic,
        )
    if message.roi.width and message.roi.height:
        width, height = message.roi.width, message.roi.height
        cx, cy = cx - message.roi.x_offset, cy - message.roi.y_offset
    return PinholeCamera(width, height, fx, fy, cx, cy)


def _rows(message: ImageLike, topic: str, dtype: np.dtype[Any], channels: int) -> NDArray[Any]:
    """Return the pixels without row padding, (H, W, channels)."""
    height, width, step = message.height, message.width, message.step
    row = width * channels * dtype.itemsize
    # Cyclone DDS gives a list of numbers, rclpy an array.
    data = np.frombuffer(bytes(message.data) if isinstance(message.data, list) else message.data, np.uint8)
    if height < 1 or width < 1 or step < row or data.size < height * step:
        raise RequestError(
            f"{topic}: {data.size} bytes are not an image of {width}x{height} {message.encoding} with rows of {step} bytes (a row needs "
            f"{row}, the image {height * max(step, row)}); fix the publisher",
            field=topic,
        )
    rows = data[: height * step].reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)


def _unread(message: ImageLike, topic: str, known: dict[str, Any]) -> RequestError:
    return RequestError(
        f"{topic}: the encoding {message.encoding!r} is not supported; publish one of {', '.join(known)}",
        field=topic,
    )
