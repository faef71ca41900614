"""What the values of a depth picture mean: z, range or disparity, as metres along the optical axis."""

from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Shaped
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.camera import PinholeCamera

#: z along the optical axis, range along the ray, or disparity between rectified pictures, pixels.
DepthKind = Literal["z", "range", "disparity"]
Depth = Float32[NDArray[np.float32], "H W"]

#: Metres for each value of CARLA's 24-bit depth: its far plane lies at 1000 m.
CARLA_SCALE_M = 1000 / (2**24 - 1)
#: What is said to be nearer or further away, no camera has seen: it is no measurement, and squares and inverses stay numbers.
LEAST_M, MOST_M = 1e-4, 1e6
#: Metres for each value of a 16-bit picture where the request names no scale: millimetres, as RGB-D cameras write.
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
    """Turn stored values into metres along the optical axis.

    Args:
        values: as stored; 0, negative, NaN and infinite mean "no measurement".
        scale_m: metres (disparity: pixels) for each stored unit.
        kind: what is stored.
        camera: the colour camera at any uniform scale of this picture; its fx and rays are scaled to it.
        baseline_m: between the two cameras, metres; needed for disparity.
        max_range_m: the sensor's limit on z (on the range, where range is stored); what lies beyond is no measurement.

    Returns:
        z, metres; 0 where nothing was measured.

    Raises:
        RequestError: the scale, the baseline or the limit is missing or not positive.
    """
    _require_positive(scale_m, "depth.scale_m", "metres for each stored unit, e.g. 0.001")
    if max_range_m is not None:
        _require_positive(max_range_m, "depth.max_range_m", "the sensor's limit in metres, or leave it out")
    height, width = values.shape
    scaled = camera.scaled_to(width, height)
    with np.errstate(all="ignore"):
        depth: NDArray[np.float32] = np.multiply(values, np.float32(scale_m), dtype=np.float32)
        if kind == "disparity":
            baseline_m = _require_positive(baseline_m, "depth.baseline_m", "metres between the cameras")
            depth = np.divide(np.float32(scaled.fx * baseline_m), depth)
        elif kind == "z" and np.issubdtype(values.dtype, np.unsignedinteger):
            # What is stored is finite, not negative, and 0 where nothing was measured.
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
    """How much longer than z the way from the camera is, at every pixel: 1 in the centre, more towards the corners.

    A distorted picture's rays are those of its pixels before rectification.
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
        raise RequestError(f"The field `{field}` is {value}; give a positive number: {meaning}.", field=field)
    return value
