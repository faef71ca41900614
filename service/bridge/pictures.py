"""Convert ROS messages to numpy images and a camera.

Any object with the fields of the ROS message is accepted, so both rclpy messages and ``service.bridge.messages`` work.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.camera import DistortionModel, PinholeCamera

#: Number of channels, and the OpenCV conversion to RGB; None if the image is RGB already.
_COLOURS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
}
#: Depth encodings of REP 118: unsigned millimetres or floating-point metres. Some drivers call the former mono16.
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
#: Our model for each ``distortion_model`` of a CameraInfo (REP 104 and drivers). Both give OpenCV's coefficients.
LENSES: dict[str, DistortionModel] = {
    "": "brown_conrady",
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
    "kannala_brandt4": "kannala_brandt",
}
#: Suffixes that image_transport adds to the name of an image topic.
_TRANSPORTS = ("compressed", "compressedDepth")


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
    distortion_model: str
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
    known = DEPTHS.get(message.encoding)
    if known is None:
        raise _unread(message, topic, DEPTHS)
    dtype = np.dtype(known).newbyteorder(">" if message.is_bigendian else "<")
    values = _rows(message, topic, dtype, 1)[..., 0].astype(np.float32)
    return values if known == "f4" else values * np.float32(0.001)


def is_rectified_by_name(topic: str) -> bool:
    """Check whether a topic's name says that its images are rectified (``image_rect_color``, ``image_rect/compressed``).

    Args:
        topic: name of the topic.
    """
    parts = [part for part in topic.split("/") if part not in _TRANSPORTS]
    return "rect" in parts[-1] if parts else False


def camera_from(message: CameraInfoLike, topic: str, *, rectified: bool = False) -> PinholeCamera:
    """Return the camera of the images, shifted by the region of interest.

    Raw images have K and the lens of the message. Rectified images have P if it is set, else K. The images count as rectified if the
    lens does not distort.

    Args:
        message: calibration of the RGB camera.
        topic: of the message; named in errors.
        rectified: the images are rectified already, although the message has distortion coefficients.

    Raises:
        RequestError: the camera is not calibrated, or the service does not know the model of its lens.
    """
    lens = None if rectified else _lens_of(message, topic)
    p, k = message.p, message.k
    fx, fy, cx, cy = (p[0], p[5], p[2], p[6]) if p[0] and lens is None else (k[0], k[4], k[2], k[5])
    width, height = message.width, message.height
    if not (fx > 0 and fy > 0 and width > 1 and height > 1):
        raise RequestError(
            f"{topic}: this camera is not calibrated (fx {fx:g}, fy {fy:g}, {width}x{height}); calibrate it, or change --info-topic",
            field=topic,
        )
    if message.roi.width and message.roi.height:
        width, height = message.roi.width, message.roi.height
        cx, cy = cx - message.roi.x_offset, cy - message.roi.y_offset
    if lens is None:
        return PinholeCamera(width, height, fx, fy, cx, cy)
    return PinholeCamera(width, height, fx, fy, cx, cy, tuple(float(each) for each in message.d), lens)


def _lens_of(message: CameraInfoLike, topic: str) -> DistortionModel | None:
    """Return the model of the lens; None if the images show no distortion."""
    lens = LENSES.get(message.distortion_model)
    if lens is None and any(message.d):
        raise RequestError(
            f"{topic}: the distortion_model {message.distortion_model!r} is not known (known: {', '.join(filter(None, LENSES))}); "
            "subscribe to the rectified topics of image_proc and pass --rectified",
            field=topic,
        )
    if lens == "kannala_brandt" and len(message.d):
        return lens
    return lens if any(message.d) else None


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
