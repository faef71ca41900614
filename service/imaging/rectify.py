"""Rectify the images of a camera whose lens distorts: both images become those of a pinhole camera.

The rest of the pipeline knows pinhole cameras only. Colour is interpolated. Depth takes the value of the nearest pixel, because a mean of
two surfaces is no surface. The depth image holds z, and rectification does not rotate the camera, so a value stays the same.

The rectified camera follows from the sent one by three rules (decision 0152):

1. The field is what the image shows within ``MOST_ASIDE_DEG`` and ``MOST_ABOVE_DEG`` of the optical axis. A pinhole image of a wider field
   would spend most of its pixels on the edge: at 60 degrees a pixel covers a quarter of the angle of the central pixel.
2. The focal lengths are those of the sent camera, so the centre of the image keeps its resolution. If the rectified image would have more
   pixels than the sent one, both focal lengths shrink by the same factor, until it has as many.
3. The size follows from the field and the focal lengths.

Pixels that the lens did not see are black, have no depth, and are not observed (``RectifiedPair.observed``).
"""

import math
import threading
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy.typing import NDArray

from service.errors import RequestError, TooLargeError
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import distorted_pixels, rays_of, reach_of
from service.option_limits import LEAST_SIDE, MOST_ASPECT

Rgb = UInt8[NDArray[np.uint8], "H W 3"]
Depth = Float32[NDArray[np.float32], "h w"]
Observed = Bool[NDArray[np.bool_], "h w"]

#: Half of the largest field of a rectified image, degrees. The view grid needs 50 degrees aside (90 degrees, and turns of 5) and 21 above
#: in its corners. The rest serves cameras that are not level, and registration.
MOST_ASIDE_DEG, MOST_ABOVE_DEG = 60.0, 45.0
#: Memory for tables, bytes in each process: those of 12 cameras of 640 x 480, or of one of 1920 x 1080. The table of a larger image is
#: computed for each request.
TABLES_BYTES = 32 * 2**20
#: Bytes of a table for each pixel.
_PIXEL_BYTES = 9
#: Longest side of an image that OpenCV remaps, pixels.
_MOST_SIDE = 32766
#: Points of each side of the image, and of the field, that bound the field.
_BORDER = 512
#: Pixels of a table that are computed at once. It bounds the memory for intermediate results.
_BAND_PIXELS = 65536
#: Where a table points if the lens saw nothing. OpenCV gives 0 for a place so far outside of the image.
_NOWHERE = -16.0

Image = TypeVar("Image", NDArray[np.uint8], NDArray[np.float32])


@dataclass(frozen=True, slots=True)
class Rectification:
    """The pinhole camera that a distorted camera is rectified to.

    Attributes:
        sent: intrinsics and distortion of the sent image.
        camera: intrinsics of the rectified image.
        reach_rad: largest angle of a ray that the sent image shows.
    """

    sent: PinholeCamera
    camera: PinholeCamera
    reach_rad: float

    def size_of(self, height: int, width: int) -> tuple[int, int]:
        """Return height and width of a rectified image whose sent image has another size than the sent camera.

        Args:
            height: rows of the sent image.
            width: columns of the sent image.
        """
        rows, columns = height / self.sent.height * self.camera.height, width / self.sent.width * self.camera.width
        return max(1, round(rows)), max(1, round(columns))


@dataclass(frozen=True, slots=True, eq=False)
class RectifiedPair:
    """An image pair of a pinhole camera.

    Attributes:
        rgb: colour image, sRGB; black where the lens saw nothing.
        depth_m: z, metres; 0 where nothing was measured.
        camera: intrinsics, without distortion.
        observed: pixels of the depth image that the lens saw; None: all.
    """

    rgb: Rgb
    depth_m: Depth
    camera: PinholeCamera
    observed: Observed | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Place in the sent image for each pixel of the rectified image.

    Attributes:
        u: column, pixels; ``_NOWHERE`` where the lens saw nothing.
        v: row, pixels; ``_NOWHERE`` where the lens saw nothing.
        observed: whether the lens saw the pixel.
    """

    u: Float32[NDArray[np.float32], "h w"]
    v: Float32[NDArray[np.float32], "h w"]
    observed: Observed

    @property
    def nbytes(self) -> int:
        return self.u.nbytes + self.v.nbytes + self.observed.nbytes


class _Tables:
    """The tables of the cameras that were used last. It is thread-safe.

    A table follows from its key alone, so all processes compute the same one.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self._bytes = limit, 0
        self._lock = threading.Lock()
        self._kept: OrderedDict[tuple[PinholeCamera, int, int], _Table] = OrderedDict()

    def get(self, rectification: Rectification, height: int, width: int) -> _Table | None:
        """Return the table of an image, or compute it; None if it is too large to keep."""
        key = (rectification.sent, height, width)
        with self._lock:
            if (known := self._kept.get(key)) is not None:
                self._kept.move_to_end(key)
                return known
        rows, columns = rectification.size_of(height, width)
        if _PIXEL_BYTES * rows * columns > self._limit:
            return None
        bands = [band for _, band in _bands(rectification, height, width)]
        table = _Table(*(np.concatenate([getattr(band, name) for band in bands]) for name in ("u", "v", "observed")))
        for array in (table.u, table.v, table.observed):
            array.flags.writeable = False
        with self._lock:
            before = self._kept.pop(key, None)
            self._kept[key] = table
            self._bytes += table.nbytes - (0 if before is None else before.nbytes)
            while self._bytes > self._limit:
                _, oldest = self._kept.popitem(last=False)
                self._bytes -= oldest.nbytes
        return table


_TABLES = _Tables(TABLES_BYTES)


@lru_cache(maxsize=64)
def rectification_of(camera: PinholeCamera) -> Rectification:
    """Choose the pinhole camera that a distorted camera is rectified to.

    Args:
        camera: intrinsics and distortion.

    Raises:
        RequestError: the distortion is not invertible over the image, or the image shows hardly anything of the field.
    """
    reach = reach_of(camera)
    field = _field_of(camera, reach)
    if field is None:
        raise _unusable(camera, "empty", "nothing")
    left, top, right, bottom = field.ravel().tolist()
    across, down = (right - left) * camera.fx, (bottom - top) * camera.fy
    scale = min(1.0, math.sqrt(camera.width * camera.height / max(across * down, 1.0)))
    fx, fy, width, height = scale * camera.fx, scale * camera.fy, round(scale * across), round(scale * down)
    if min(width, height) < LEAST_SIDE or max(width, height) > MOST_ASPECT * min(width, height):
        raise _unusable(camera, f"a strip of {width}x{height} pixels", "hardly anything")
    pinhole = PinholeCamera(width, height, fx, fy, -left * fx - 0.5, -top * fy - 0.5)
    return Rectification(camera, pinhole, reach)


def rectified_pair(rgb: Rgb, depth_m: Depth, camera: PinholeCamera) -> RectifiedPair:
    """Rectify an image pair.

    Args:
        rgb: sRGB image with the aspect ratio of the camera.
        depth_m: z of each pixel of the distorted image, metres, 0 where nothing was measured. It has the aspect ratio of the camera.
        camera: intrinsics and distortion of both images.

    Returns:
        The pair of the pinhole camera. The same images if the camera has no distortion.

    Raises:
        RequestError: as ``rectification_of``.
        TooLargeError: a side of an image is too long.
    """
    if not camera.is_distorted:
        return RectifiedPair(rgb, depth_m, camera)
    rectification = rectification_of(camera)
    for field, image in (("rgb", rgb), ("depth", depth_m)):
        if max(image.shape[:2]) > _MOST_SIDE:
            raise TooLargeError(
                f"The image `{field}` has {image.shape[1]}x{image.shape[0]} pixels, but a distorted image may have at most {_MOST_SIDE} "
                "along a side; send smaller images, or rectify them.",
                field=field,
            )
    smooth, _ = _remapped(rgb, rectification, cv2.INTER_LINEAR)
    nearest, observed = _remapped(depth_m, rectification, cv2.INTER_NEAREST)
    return RectifiedPair(smooth, nearest, rectification.camera, None if observed.all() else observed)


def _remapped(image: Image, rectification: Rectification, interpolation: int) -> tuple[Image, Observed]:
    """Rectify one image, and mark the pixels that the lens saw."""
    height, width = image.shape[:2]
    table = _TABLES.get(rectification, height, width)
    if table is not None:
        return _moved(image, table, interpolation), table.observed
    rows, columns = rectification.size_of(height, width)
    moved, observed = np.empty((rows, columns, *image.shape[2:]), image.dtype), np.empty((rows, columns), np.bool_)
    for first, band in _bands(rectification, height, width):
        moved[first : first + len(band.u)] = _moved(image, band, interpolation)
        observed[first : first + len(band.u)] = band.observed
    return moved, observed


def _moved(image: Image, table: _Table, interpolation: int) -> Image:
    moved = cv2.remap(image, table.u, table.v, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(moved, image.dtype)


def _bands(rectification: Rectification, height: int, width: int) -> Iterator[tuple[int, _Table]]:
    """Compute the table of an image in bands of rows: the first row of each band, and its part of the table.

    Args:
        rectification: of the camera.
        height: rows of the sent image.
        width: columns of the sent image.
    """
    sent = rectification.sent.scaled_to(width, height)
    rows, columns = rectification.size_of(height, width)
    pinhole = rectification.camera.scaled_to(columns, rows)
    most = math.tan(min(rectification.reach_rad, math.radians(89.0)))
    x = (np.arange(columns) - pinhole.cx) / pinhole.fx
    at_once = max(1, _BAND_PIXELS // columns)
    for first in range(0, rows, at_once):
        count = min(at_once, rows - first)
        u, v = _places(sent, pinhole, first, count)
        y = (np.arange(first, first + count) - pinhole.cy) / pinhole.fy
        observed = (x * x + (y * y)[:, None] <= most * most) & _is_inside(sent, u, v)
        yield first, _Table(_within(u, width, observed), _within(v, height, observed), observed)


def _within(
    place: Float32[NDArray[np.float32], "h w"], side: int, observed: Observed
) -> Float32[NDArray[np.float32], "h w"]:
    """Keep places inside the image, so that no pixel is mixed with the outside; ``_NOWHERE`` where the lens saw nothing."""
    inside = np.where(observed, np.clip(place, 0, side - 1), np.float32(_NOWHERE))
    return inside.astype(np.float32, copy=False)


def _places(
    sent: PinholeCamera, pinhole: PinholeCamera, first: int, count: int
) -> tuple[Float32[NDArray[np.float32], "h w"], Float32[NDArray[np.float32], "h w"]]:
    """Project the pixels of some rows of the pinhole image into the sent image, pixels."""
    rectify = (
        cv2.fisheye.initUndistortRectifyMap
        if sent.distortion_model == "kannala_brandt"
        else cv2.initUndistortRectifyMap
    )
    K = pinhole.matrix
    K[1, 2] -= first
    u, v = rectify(
        sent.matrix, np.array(sent.distortion, np.float64), np.eye(3), K, (pinhole.width, count), cv2.CV_32FC1
    )
    return np.asarray(u, np.float32), np.asarray(v, np.float32)


def _is_inside(camera: PinholeCamera, u: NDArray[np.floating], v: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether points lie in an image, up to the outer edges of its pixels. False for NaN."""
    inside: NDArray[np.bool_] = (u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5)
    return inside


def _field_of(camera: PinholeCamera, reach: float) -> Float64[NDArray[np.float64], "2 2"] | None:
    """Bound the rays that the image shows within the largest field; None if it shows none of them.

    The extremes lie on the border of the image inside the field, or on the border of the field inside the image.

    Returns:
        Least and largest x / z and y / z.
    """
    most = np.array([math.tan(math.radians(MOST_ASIDE_DEG)), math.tan(math.radians(MOST_ABOVE_DEG))])
    edges = _border(np.array([-0.5, -0.5]), np.array([camera.width - 0.5, camera.height - 0.5]))
    rays = rays_of(camera, edges)
    rays = rays[rays[:, 2] > 1e-3]  # false for NaN
    of_image = rays[:, :2] / rays[:, 2:]
    of_field = _border(-most, most)
    of_field = of_field[np.arctan(np.hypot(*of_field.T)) <= reach]
    pixels = distorted_pixels(camera, of_field)
    shown = np.concatenate(
        [of_image[(np.abs(of_image) <= most).all(axis=1)], of_field[_is_inside(camera, pixels[:, 0], pixels[:, 1])]]
    )
    return np.stack([shown.min(axis=0), shown.max(axis=0)]) if len(shown) else None


def _border(
    low: Float64[NDArray[np.float64], "2"], high: Float64[NDArray[np.float64], "2"]
) -> Float64[NDArray[np.float64], "n 2"]:
    """Return points on the border of a rectangle, with its corners."""
    x, y = np.linspace(low[0], high[0], _BORDER), np.linspace(low[1], high[1], _BORDER)
    sides = [np.stack([x, np.full(_BORDER, each)], axis=1) for each in (low[1], high[1])]
    sides += [np.stack([np.full(_BORDER, each), y], axis=1) for each in (low[0], high[0])]
    return np.concatenate(sides)


def _unusable(camera: PinholeCamera, what: str, shown: str) -> RequestError:
    return RequestError(
        f"camera: the rectified image would be {what}, because the image ({camera.width}x{camera.height}) shows {shown} within "
        f"{MOST_ASIDE_DEG:g} degrees beside and {MOST_ABOVE_DEG:g} degrees above and below the optical axis; check cx, cy, fx, fy and "
        "distortion, and send the intrinsics of the whole image or of the crop that you send",
        field="camera",
    )
