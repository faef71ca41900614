"""Convert the stored values of a depth image (z, range or disparity) to metres along the optical axis."""

import math
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Float64, Shaped
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import rays_of

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
#: Distance between the rays of a distorted image that are computed exactly, radians at the centre of the image, and their largest number
#: along a side. The cosine is interpolated between them. Within 63 degrees of the optical axis this moves z by less than 1e-4 of its value.
_RAY_STEP_RAD, _MOST_RAYS = 0.01, 256


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
        Depth z in metres, 0 where nothing was measured. Values outside ``LEAST_M`` to ``MOST_M`` count as not measured. With
        distortion, the pixels are those of the distorted image.

    Raises:
        RequestError: the scale, the baseline or the limit is missing or not positive. The camera has distortion, and the values are
            disparities or the distortion is not invertible over the image.
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
            if camera.is_distorted:
                raise RequestError(
                    "depth.kind: a disparity is measured between rectified images, but camera.distortion says that the images are not "
                    "rectified; send the rectified left image without camera.distortion, or send depth in metres (z)",
                    field="depth.kind",
                )
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
        if kind == "range" and scaled.is_distorted:
            depth = np.multiply(depth, ray_cosines(scaled))
            usable &= depth >= LEAST_M  # a fisheye lens also sees rays that have no z
        elif kind == "range":
            depth = np.divide(depth, ray_lengths(scaled).astype(np.float32))
    return np.where(usable, depth, np.float32(0)).astype(np.float32, copy=False)


def ray_lengths(camera: PinholeCamera) -> Float64[NDArray[np.float64], "H W"]:
    """Compute the ratio of range to z for every pixel of an image without distortion.

    The ratio is 1 on the optical axis and grows towards the corners.

    Args:
        camera: intrinsics, pixels. Its width and height give the shape of the result.
    """
    x, y = (np.arange(camera.width) - camera.cx) / camera.fx, (np.arange(camera.height) - camera.cy) / camera.fy
    rays: NDArray[np.float64] = np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)
    return rays


def ray_cosines(camera: PinholeCamera) -> Depth:
    """Compute the ratio of z to range for every pixel of a distorted image, i.e. before rectification.

    Args:
        camera: intrinsics and distortion, pixels. Its width and height give the shape of the result.

    Returns:
        Cosine of the angle between ray and optical axis; 0 for rays that are more than a right angle from it, and where the lens sees
        nothing.

    Raises:
        RequestError: the distortion is not invertible over the image.
    """
    grid = _cosine_grid(camera)
    across = _between(grid.shape[1], camera.width)
    wide = grid[:, across[0]] * (1 - across[1]) + grid[:, across[0] + 1] * across[1]
    row, share = _between(grid.shape[0], camera.height)
    cosines: Depth = wide[row]
    cosines += (wide[row + 1] - cosines) * share[:, None]
    return cosines


def _between(nodes: int, size: int) -> tuple[NDArray[np.intp], Float32[NDArray[np.float32], " size"]]:
    """Return the node before each pixel, and the pixel's share of the way to the next node."""
    at = np.arange(size) * ((nodes - 1) / max(size - 1, 1))
    before = np.minimum(at.astype(np.intp), nodes - 2)
    return before, (at - before).astype(np.float32)


@lru_cache(maxsize=16)
def _cosine_grid(camera: PinholeCamera) -> Float32[NDArray[np.float32], "rows columns"]:
    """Cosines of rays on a coarse grid from the first to the last pixel centre."""
    step = max(1.0, _RAY_STEP_RAD * min(camera.fx, camera.fy))
    u, v = (
        np.linspace(0, size - 1, min(max(2, math.ceil((size - 1) / step) + 1), _MOST_RAYS))
        for size in (camera.width, camera.height)
    )
    rays = rays_of(camera, np.stack(np.meshgrid(u, v), axis=-1))
    cosines = np.nan_to_num(np.maximum(rays[..., 2], 0)).astype(np.float32)
    cosines.flags.writeable = False
    return cosines


def _require_positive(value: float | None, field: str, meaning: str) -> float:
    if value is None or not np.isfinite(value) or value <= 0:
        raise RequestError(f"The field `{field}` is {value}; send a positive number: {meaning}.", field=field)
    return value
