"""From one RGB and one depth picture to the planes that the encoder reads."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy.typing import NDArray

from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, rotation_z
from service.imaging.brightness import brightness
from service.imaging.fusion import fuse_planes
from service.imaging.ihs import ihs_linear
from service.imaging.level import level_camera
from service.imaging.view_grid import PLANES, Planes, ViewGrid, heights_of

#: Each cell is sampled by 3 x 3 rays; the median of the measured ones stands, if there are at least this many.
SUB_RAYS = 3
FEWEST_SAMPLES = 3


@dataclass(frozen=True, slots=True)
class QueryView:
    """The planes of a query and what was found on the way."""

    planes: Planes
    R_level_camera: Rotation
    height_m: float
    measured_share: float


@dataclass(frozen=True, slots=True, eq=False)
class QueryViews:
    """The same query seen at several turns, counter-clockwise against the optical axis (rad)."""

    planes: Float32[NDArray[np.float32], "T 6 rows columns"]
    turns_rad: tuple[float, ...]
    R_level_camera: Rotation
    height_m: float
    measured_share: float


def query_view(
    rgb: UInt8[NDArray[np.uint8], "H W 3"],
    depth_m: Float32[NDArray[np.float32], "h w"],
    camera: PinholeCamera,
    *,
    grid: ViewGrid,
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    down_camera: Float64[NDArray[np.float64], "3"] | None = None,
    nominal_height_m: float = 1.5,
    turn_rad: float = 0.0,
) -> QueryView:
    """One view of a query; see ``query_views``."""
    views = query_views(
        rgb, depth_m, camera, grid=grid, rows_seen=rows_seen, turns_rad=(turn_rad,),
        down_camera=down_camera, nominal_height_m=nominal_height_m,
    )  # fmt: skip
    return QueryView(views.planes[0], views.R_level_camera, views.height_m, views.measured_share)


def query_views(
    rgb: UInt8[NDArray[np.uint8], "H W 3"],
    depth_m: Float32[NDArray[np.float32], "h w"],
    camera: PinholeCamera,
    *,
    grid: ViewGrid,
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    turns_rad: tuple[float, ...],
    down_camera: Float64[NDArray[np.float64], "3"] | None = None,
    nominal_height_m: float = 1.5,
) -> QueryViews:
    """Level, resample to the view grid, fuse (paper, section 3, testing stage).

    Args:
        rgb: sRGB, of the camera's aspect.
        depth_m: z, metres, 0 where nothing was measured; of the camera's aspect.
        camera: pinhole intrinsics.
        grid: the map's view grid.
        rows_seen: rows that the map's survey covers; the others are cut here too.
        turns_rad: headings of the views against the optical axis, counter-clockwise.
        down_camera: gravity in the camera frame, if known.
        nominal_height_m: of the camera above the ground, where the picture does not show it.

    Raises:
        NoDepthError: no cell of the grid holds a measurement.
    """
    level = level_camera(depth_m, camera, down_camera=down_camera, nominal_height_m=nominal_height_m)
    sub_rays = _sub_rays(grid)
    planes = np.zeros((len(turns_rad), len(PLANES), grid.rows, grid.columns), np.float32)
    for view, turn_rad in zip(planes, turns_rad, strict=True):
        rays_camera = sub_rays @ (rotation_z(turn_rad).T @ level.R_level_camera)
        ranges, observed = _median_ranges(depth_m, camera, rays_camera, grid)
        seen = observed & rows_seen[:, None]
        ranges = ranges * seen
        colour = _mean_colour(rgb, camera, rays_camera, grid) * seen[..., None]
        view[:3] = fuse_planes(colour, ranges)
        view[3] = heights_of(ranges, level.height_m, grid)
        view[4] = seen
        view[5] = brightness(ihs_linear(colour)[0], measured=ranges > 0, seen=seen)
    if not planes[:, 0].any():
        raise NoDepthError(
            "the depth picture has no measurement inside the view grid "
            f"({grid.min_range_m:g}-{grid.max_range_m:g} m, {grid.elevation_bottom_deg:g} to "
            f"{grid.elevation_top_deg:g} degrees of elevation): check scale, kind and the camera's intrinsics",
            field="depth",
        )
    return QueryViews(planes, turns_rad, level.R_level_camera, level.height_m, float(np.mean(planes[:, 0] > 0)))


def _sub_rays(grid: ViewGrid) -> Float64[NDArray[np.float64], "n 3"]:
    """Unit rays, level frame, ``SUB_RAYS`` squared for each cell, cell by cell."""
    rows, columns = grid.elevations_rad, grid.azimuths_rad
    spread = (np.arange(SUB_RAYS) - (SUB_RAYS - 1) / 2) / SUB_RAYS
    row_step, column_step = abs(rows[1] - rows[0]), abs(columns[1] - columns[0])
    elevation = rows[:, None, None, None] + spread[None, None, :, None] * row_step
    azimuth = columns[None, :, None, None] + spread[None, None, None, :] * column_step
    elevation, azimuth = np.broadcast_arrays(elevation, azimuth)
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return rays.reshape(-1, 3)


def _pixels(
    camera: PinholeCamera, shape: tuple[int, int], rays_camera: Float64[NDArray[np.float64], "n 3"]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Flat index of the pixel that each ray meets in a picture of a shape, and whether it meets one."""
    height, width = shape
    own = camera if (camera.height, camera.width) == shape else camera.scaled_to(width, height)
    ahead = rays_camera[:, 2] > 1e-3
    z = np.where(ahead, rays_camera[:, 2], 1.0)
    u = np.rint(rays_camera[:, 0] / z * own.fx + own.cx)
    v = np.rint(rays_camera[:, 1] / z * own.fy + own.cy)
    inside = ahead & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = np.where(inside, v * width + u, 0).astype(np.int64)
    return index, inside


def _median_ranges(
    depth_m: Float32[NDArray[np.float32], "h w"],
    camera: PinholeCamera,
    rays_camera: Float64[NDArray[np.float64], "n 3"],
    grid: ViewGrid,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    index, inside = _pixels(camera, depth_m.shape, rays_camera)
    z = depth_m.reshape(-1)[index]
    # A ray of unit length has its depth at z / ray_z.
    distance = z / np.maximum(rays_camera[:, 2], 1e-3).astype(np.float32)
    usable = inside & (distance >= grid.min_range_m) & (distance <= grid.max_range_m)
    samples = np.where(usable, distance, np.float32(np.inf)).reshape(grid.rows * grid.columns, -1)
    samples.sort(axis=1)
    count = np.count_nonzero(np.isfinite(samples), axis=1)
    middle = np.maximum(count - 1, 0) // 2
    median = samples[np.arange(len(samples)), middle]
    ranges = np.where(count >= FEWEST_SAMPLES, median, np.float32(0)).astype(np.float32)
    seen = inside.reshape(grid.rows * grid.columns, -1).any(axis=1)
    shape = (grid.rows, grid.columns)
    return ranges.reshape(shape), seen.reshape(shape)


def _mean_colour(
    rgb: UInt8[NDArray[np.uint8], "H W 3"],
    camera: PinholeCamera,
    rays_camera: Float64[NDArray[np.float64], "n 3"],
    grid: ViewGrid,
) -> Float32[NDArray[np.float32], "rows columns 3"]:
    """Mean colour of each cell, 0 to 255; black where the camera does not look."""
    index, inside = _pixels(camera, rgb.shape[:2], rays_camera)
    colour = rgb.reshape(-1, 3)[index].astype(np.float32) * inside[:, None]
    colour = colour.reshape(grid.rows, grid.columns, -1, 3).sum(axis=2)
    count = inside.reshape(grid.rows, grid.columns, -1).sum(axis=2)
    mean: Float32[NDArray[np.float32], "rows columns 3"] = colour / np.maximum(count, 1)[..., None].astype(np.float32)
    return mean
