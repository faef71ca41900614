"""Convert the stored values of a depth image (z, range or disparity) to metres along the optical axis."""

from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Shaped
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.camera import PinholeCamera

#: Stored quantity: z along the optical axis, range along the ray, or disparity between rectified images (pixels).
DepthKind = Literal["z", "range", "disparity"]
Depth = Float32[NDArray[np.float32], "H W"]

#: Metres per stored unit of CARLA's 24-bit depth. Its far plane lies at 1000 m.
CARLA_SCALE_M = 1000 / (2**24 - 1)
#: Smallest and largest valid depth, metres. No camera measures values outside, so they count as not measured.
#: Within these bounds, squares and inverses stay finite.
LEAST_M, MOST_M = 1e-4, 1e6
#: Metres per stored unit of an integer image if the request names no scale: millimetres, as RGB-D cameras write.
INTEGER_SCALE_M = 0.001


def depth_from_values(
    values: Shaped[NDArray[Any], "H W"],
    *,
    scale_m: float,
    kind: DepthKind,
    camera: PinholeCamera,
    baseline_m: float | None,
    max_range_m: float | None,
) -> Depth:
    """Convert stored values to metres along the optical axis.

    Args:
        values: stored values. 0, negative, NaN and infinite values mean "not measured".
        scale_m: metres (disparity: pixels) per stored unit.
        kind: stored quantity.
        camera: colour camera, at any uniform scale of this image. Its fx and its rays are scaled to this image.
        baseline_m: distance between the two cameras, metres. Disparity needs it.
        max_range_m: limit of the sensor, metres. It applies to z, or to the range if the range is stored. Values beyond it
            count as not measured.

    Returns:
        Depth z in metres, 0 where nothing was measured. Values outside ``LEAST_M`` to ``MOST_M`` count as not measured.

    Raises:
        RequestError: the scale, the baseline or the limit is missing or not positive.
    """
    _require_positive(scale_m, "depth.scale_m", "metres for each stored unit, e.g. 0.001")
    if max_range_m is not None:
        _require_positive(
            max_range_m, "depth.max_range_m", "the range limit of the sensor in metres, or omit the field"
        )
    height, width = values.shape
    scaled = camera.scaled_to(width, height)
    with np.errstate(all="ignore"):
        depth: NDArray[np.float32] = np.multiply(values, np.float32(scale_m), dtype=np.float32)
        if kind == "disparity":
            baseline_m = _require_positive(baseline_m, "depth.baseline_m", "metres between the cameras")
            depth = np.divide(np.float32(scaled.fx * baseline_m), depth)
        elif kind == "z" and np.issubdtype(values.dtype, np.unsignedinteger):
            # Unsigned integers are finite and not negative, and 0 already means "not measured". So no mask is
            # needed if no stored value can lie outside the limits.
            limit_m = MOST_M if max_range_m is None else min(max_range_m, MOST_M)
            if scale_m >= LEAST_M and float(np.iinfo(values.dtype).max) * scale_m <= limit_m:
                return depth
            return np.where((depth >= LEAST_M) & (depth <= limit_m), depth, np.float32(0))
        usable = np.isfinite(depth) & (depth >= LEAST_M) & (depth <= MOST_M)
        if max_range_m is not None:
            usable &= depth <= max_range_m
        if kind == "range":
            depth = np.divide(depth, ray_lengths(scaled).astype(np.float32))
    return np.where(usable, depth, np.float32(0)).astype(np.float32, copy=False)


def ray_lengths(camera: PinholeCamera) -> Float64[NDArray[np.float64], "H W"]:
    """Compute the ratio of range to z for every pixel.

    The ratio is 1 on the optical axis and grows towards the corners. With distortion coefficients, the rays are those of the
    distorted pixels, i.e. before rectification.

    Args:
        camera: intrinsics, pixels. Its width and height give the shape of the result.
    """
    if not camera.distortion:
        x, y = (np.arange(camera.width) - camera.cx) / camera.fx, (np.arange(camera.height) - camera.cy) / camera.fy
        rays: NDArray[np.float64] = np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
        return rays
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(np.float64)
    xy = cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.matrix, np.array(camera.distortion))
    lengths: NDArray[np.float64] = np.sqrt(1 + (xy**2).sum(axis=-1)).reshape(camera.height, camera.width)
    return lengths


def _require_positive(value: float | None, field: str, meaning: str) -> float:
    if value is None or not np.isfinite(value) or value <= 0:
        raise RequestError(f"The field `{field}` is {value}; send a positive number: {meaning}.", field=field)
    return value
