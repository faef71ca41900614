"""Convert one RGB and one depth image to the planes that the encoder reads."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy.typing import NDArray

from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, rotation_z
from service.imaging.depth_unit_hint import unit_hint
from service.imaging.fusion import fuse
from service.imaging.level import GivenHeight, HeightOrigin, level_query
from service.imaging.resample import resample
from service.imaging.view_grid import PLANES, Planes, ViewGrid, brightness, heights_of


@dataclass(frozen=True, slots=True)
class QueryView:
    """One view of a query.

    Attributes:
        planes: input planes of the encoder, see ``service.imaging.view_grid.PLANES``.
        R_level_camera: rotation from the optical frame to the level frame, (3, 3).
        height_m: height of the camera above the ground, metres.
        measured_share: share of cells with a range.
    """

    planes: Planes
    R_level_camera: Rotation
    height_m: float
    measured_share: float


@dataclass(frozen=True, slots=True, eq=False)
class QueryViews:
    """Several views of one query at different headings.

    Attributes:
        planes: input planes of the encoder for each heading, see ``service.imaging.view_grid.PLANES``.
        turns_rad: heading of each view relative to the optical axis, counter-clockwise, radians.
        R_level_camera: rotation from the optical frame to the level frame, (3, 3).
        height_m: height of the camera above the ground, metres.
        measured_share: share of cells with a range, over all views.
        height_origin: where ``height_m`` comes from.
    """

    planes: Float32[NDArray[np.float32], "T 6 rows columns"]
    turns_rad: tuple[float, ...]
    R_level_camera: Rotation
    height_m: float
    measured_share: float
    height_origin: HeightOrigin = "assumed"


def query_view(
    rgb: UInt8[NDArray[np.uint8], "H W 3"],
    depth_m: Float32[NDArray[np.float32], "h w"],
    camera: PinholeCamera,
    *,
    grid: ViewGrid,
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    down_camera: Float64[NDArray[np.float64], "3"] | None = None,
    given_height: GivenHeight | None = None,
    turn_rad: float = 0.0,
    observed: Bool[NDArray[np.bool_], "h w"] | None = None,
) -> QueryView:
    """Compute one view of a query at any heading. ``query_views`` describes the method.

    Args:
        rgb: sRGB image with the aspect ratio of the camera.
        depth_m: z, metres, 0 where nothing was measured. It has the aspect ratio of the camera.
        camera: pinhole intrinsics, pixels.
        grid: view grid of the map.
        rows_seen: rows that the survey of the map covers. The other rows are blanked.
        down_camera: direction of gravity in the camera frame, any length, if known.
        given_height: height of the camera above the ground, if the caller knows it. None: it is found in the depth image.
        turn_rad: heading of the view relative to the optical axis, counter-clockwise, radians.
        observed: pixels of the depth image that the lens saw; None: all.

    Raises:
        NoDepthError: no cell of the grid holds a measurement (raised by ``query_views``).
    """
    views = query_views(
        rgb,
        depth_m,
        camera,
        grid=grid,
        rows_seen=rows_seen,
        turns=(0,),
        turn_rad=turn_rad,
        down_camera=down_camera,
        given_height=given_height,
        observed=observed,
    )
    return QueryView(views.planes[0], views.R_level_camera, views.height_m, views.measured_share)


def query_views(
    rgb: UInt8[NDArray[np.uint8], "H W 3"],
    depth_m: Float32[NDArray[np.float32], "h w"],
    camera: PinholeCamera,
    *,
    grid: ViewGrid,
    rows_seen: Bool[NDArray[np.bool_], " rows"],
    turns: tuple[int, ...],
    turn_rad: float = 0.0,
    down_camera: Float64[NDArray[np.float64], "3"] | None = None,
    given_height: GivenHeight | None = None,
    observed: Bool[NDArray[np.bool_], "h w"] | None = None,
) -> QueryViews:
    """Level a query, resample it to the view grid, and fuse colour and depth (paper, section 3, testing stage).

    All views are cut out of one wide view.

    Args:
        rgb: sRGB image with the aspect ratio of the camera.
        depth_m: z, metres, 0 where nothing was measured. It has the aspect ratio of the camera.
        camera: pinhole intrinsics, pixels.
        grid: view grid of the map.
        rows_seen: rows that the survey of the map covers. The other rows are blanked here too (decision 0006).
        turns: headings of the views relative to ``turn_rad``, in whole columns of the grid, counter-clockwise.
        turn_rad: heading relative to the optical axis that ``turns`` start from, counter-clockwise, radians.
        down_camera: direction of gravity in the camera frame, any length, if known.
        given_height: height of the camera above the ground, if the caller knows it. None: it is found in the depth image.
        observed: pixels of the depth image that the lens saw; None: all. A cell without such a pixel is not observed.

    Raises:
        NoDepthError: no cell of the grid holds a measurement.
    """
    level, height_origin = level_query(depth_m, camera, down_camera=down_camera, given=given_height)
    aside = max(abs(turn) for turn in turns)
    R_camera_view = level.R_level_camera.T @ rotation_z(turn_rad)
    ranges, colour, seen = resample(rgb, depth_m, camera, R_camera_view, grid.widened(aside), observed)
    seen &= rows_seen[:, None]
    ranges *= seen
    colour *= seen[..., None]
    fused, intensity = fuse(colour, ranges)
    wide = np.concatenate([fused, np.stack([heights_of(ranges, level.height_m, grid), seen])])
    planes = np.empty((len(turns), len(PLANES), grid.rows, grid.columns), np.float32)
    for view, turn in zip(planes, turns, strict=True):
        cut = slice(aside - turn, aside - turn + grid.columns)
        view[:5] = wide[:, :, cut]
        view[5] = brightness(intensity[:, cut], measured=view[0] > 0, seen=seen[:, cut])
    if not planes[:, 0].any():
        raise _no_depth(depth_m, grid)
    turns_rad = tuple(turn_rad + turn * grid.column_rad for turn in turns)
    measured_share = float(np.mean(planes[:, 0] > 0))
    return QueryViews(planes, turns_rad, level.R_level_camera, level.height_m, measured_share, height_origin)


def _no_depth(depth_m: Float32[NDArray[np.float32], "h w"], grid: ViewGrid) -> NoDepthError:
    if not depth_m.any():
        why = "no pixel has a depth: check the depth image, and depth.max_range_m if you sent it"
    else:
        why = unit_hint(depth_m) or "check depth.scale_m, depth.kind and the camera intrinsics"
    return NoDepthError(
        "the depth image has no measurement inside the view grid "
        f"({grid.min_range_m:g}-{grid.max_range_m:g} m, {grid.elevation_bottom_deg:g} to "
        f"{grid.elevation_top_deg:g} degrees of elevation): {why}",
        field="depth",
    )
