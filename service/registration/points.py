"""Convert a depth image to points for registration, each with its uncertainty.

The disparity error of a triangulating camera does not depend on range. So its range error grows with the square of the range.
The image itself shows how large the error is. On a plane the inverse depth is linear in the pixel, so its second difference is noise.

Speed: ``points.c`` takes a third of the time of NumPy for the blocks, and half for the noise (26 November 2026, decision 0148).
"""

import ctypes
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation
from service.imaging.view_grid import MAX_RANGE_M
from service.registration.kernel import QueryPoints

LIBRARY = Path(__file__).with_name("_points.so")
#: Noise estimation: every eighth row, distances between pixels (px), least number of second differences. The larger estimate counts.
#: Errors of stereo matching are correlated over the matcher's window, so differences of adjacent pixels hide them. On KITTI pairs matched
#: by SGBM, pixels 2 apart show 0.08 px of disparity noise and pixels 8 apart show 0.30 px (decision 0131). Independent noise looks the
#: same at both distances.
NOISE_ROWS, NOISE_STEPS, FEWEST_DIFFERENCES = 8, (2, 8), 100
#: Least standard deviation of an inverse depth, 1/m. Depth in whole millimetres, or of one constant wall, has second differences of
#: zero, although no sensor measures without error. The limit is 0.1 mm at 10 m and 1.6 mm at 40 m. Every depth camera and survey LiDAR
#: has larger errors.
LEAST_NOISE = 1e-6
#: Least standard deviation of a stereo rig's disparity, px. Errors of rectification and of whole-pixel matching are equal over a whole
#: surface, so no image shows them. SGBM on KITTI against the scans: 0.45 to 0.85 px (decision 0131).
MATCHING_PX = 0.5
#: Focal length (px) times baseline (m) of the stereo camera that is assumed where none is known. Simulation and training model it too.
FOCAL_BASELINE_PX_M = 80.0
#: Points lower than ``GROUND_M`` above the ground (m) are ground points. Vehicles and people are lower than ``MOVABLE_M``.
GROUND_M, MOVABLE_M = 0.3, 2.0


class _Blocks(Structure):
    _fields_ = [
        *((name, c_int64) for name in ("width", "size", "skip", "rows", "columns")),
        *((name, c_double) for name in ("edge", "noise", "reach")),
    ]


@cache
def _library() -> ctypes.CDLL:
    library = load(LIBRARY, {"Blocks": _Blocks})
    library.streetfix_blocks.argtypes = [c_void_p, POINTER(_Blocks), c_void_p]
    library.streetfix_blocks.restype = None
    library.streetfix_second_differences.argtypes = [c_void_p, c_int64, c_int64, c_int64, c_int64, c_void_p]
    library.streetfix_second_differences.restype = c_int64
    return library


@dataclass(frozen=True, slots=True, kw_only=True)
class PointSettings:
    """Settings that thin a depth image to points, of November 2026.

    Attributes:
        columns: blocks across the image. A block gives one point, its median.
        points: largest number of points.
        ground_share: largest share of ground points. The ground does not constrain the horizontal position.
        ground_m: points lower than this above the ground are ground points, m.
        edge: a block lies on an edge if its inverse depths spread by more than this share of their median, apart from noise.
        floor_m: least standard deviation of a range, m.
        reach_m: points beyond this depth are left out, m.
        movable_m: points between ``ground_m`` and this height may be vehicles or people that have moved since the survey, m.
        movable_weight: weight of these points; all others have weight 1.
    """

    columns: int = 128
    points: int = 3000
    ground_share: float = 0.25
    ground_m: float = GROUND_M
    edge: float = 0.12
    floor_m: float = 0.02
    reach_m: float = MAX_RANGE_M
    movable_m: float = MOVABLE_M
    movable_weight: float = 0.1

    def __post_init__(self) -> None:
        """Refuse a share that would leave no point above the ground.

        Raises:
            ValueError: ``ground_share`` is out of range.
        """
        if not 0 <= self.ground_share < 1:
            raise ValueError(f"ground_share: {self.ground_share:g} must be at least 0 and less than 1")


class DepthNoise(NamedTuple):
    """Standard deviations of one pixel's inverse depth, 1/m.

    Attributes:
        independent: of the errors that adjacent pixels do not share.
        total: of all errors, with those that adjacent pixels share.
    """

    independent: float
    total: float


def inverse_depth_noise(
    depth_m: Float32[NDArray[np.float32], "H W"], *, focal_baseline_px_m: float | None = None
) -> DepthNoise:
    """Estimate the noise of a depth image from second differences of the inverse depth along rows.

    Args:
        depth_m: depth z, m; 0 where nothing was measured.
        focal_baseline_px_m: focal length times baseline of a stereo rig, px m. With it ``MATCHING_PX`` is added in quadrature to the
            total. None if the depth has no disparity.

    Returns:
        The noise, at least ``LEAST_NOISE``. An image with too few measurements gets a quarter of a pixel at ``FOCAL_BASELINE_PX_M``.
    """
    near, far = (_noise_between(depth_m, step) for step in NOISE_STEPS)
    near = near or far or 0.25 / FOCAL_BASELINE_PX_M
    total = max(near, far)
    if focal_baseline_px_m is not None:
        total = float(np.hypot(total, MATCHING_PX / focal_baseline_px_m))
    return DepthNoise(near, total)


def _noise_between(depth_m: Float32[NDArray[np.float32], "H W"], step: int) -> float:
    """Noise from pixels that are ``step`` apart; 0 if there are too few differences.

    The factor 1.4826 turns a median absolute value into a standard deviation. A second difference has six times the variance of a pixel.
    """
    depth_m = np.ascontiguousarray(depth_m, np.float32)
    height, width = depth_m.shape
    room = np.empty(-(-height // NOISE_ROWS) * width, np.float32)
    known = _library().streetfix_second_differences(
        depth_m.ctypes.data, height, width, NOISE_ROWS, step, room.ctypes.data
    )
    if known < FEWEST_DIFFERENCES:
        return 0.0
    return max(float(1.4826 * np.median(room[:known]) / np.sqrt(6.0)), LEAST_NOISE)


@dataclass(frozen=True, slots=True, eq=False)
class DepthBlocks:
    """A depth image thinned to blocks.

    Attributes:
        z_m: depth of each block from its median inverse depth, m; 0 if too few pixels are measured, on an edge, or beyond the reach.
        camera: intrinsics of the small image that has one pixel per block.
        covered: shares of the image's width and height that the blocks cover, from the left and from the top. A rest makes no block.
    """

    z_m: Float32[NDArray[np.float32], "H W"]
    camera: PinholeCamera
    covered: tuple[float, float]


def blocks_of(
    depth_m: Float32[NDArray[np.float32], "H W"], camera: PinholeCamera, settings: PointSettings, *, noise: float
) -> DepthBlocks:
    """Thin a depth image to blocks.

    Args:
        depth_m: depth z, m; 0 where nothing was measured.
        camera: intrinsics, scaled to the size of the depth image if they are of another size.
        settings: of the blocks and their edges.
        noise: standard deviation of one pixel's inverse depth, 1/m.
    """
    height, width = depth_m.shape
    own = camera if (camera.height, camera.width) == (height, width) else camera.scaled_to(width, height)
    size = max(1, width // settings.columns)
    rows, columns = height // size, width // size
    skip = max(1, size // 4)  # at most 49 pixels of a block are read
    depth_m, z = np.ascontiguousarray(depth_m, np.float32), np.empty((rows, columns), np.float32)
    _library().streetfix_blocks(
        depth_m.ctypes.data,
        byref(_Blocks(width, size, skip, rows, columns, settings.edge, noise, settings.reach_m)),
        z.ctypes.data,
    )
    centre_px = float(np.arange(0, size, skip).mean())  # the centre of the pixels read, which is not the block's
    small = PinholeCamera(
        columns, rows, own.fx / size, own.fy / size, (own.cx - centre_px) / size, (own.cy - centre_px) / size
    )
    return DepthBlocks(z, small, (columns * size / width, rows * size / height))


def points_of(
    depth_m: Float32[NDArray[np.float32], "H W"],
    camera: PinholeCamera,
    R_level_camera: Rotation,
    height_m: float,
    settings: PointSettings,
    *,
    noise: float | None = None,
    focal_baseline_px_m: float = FOCAL_BASELINE_PX_M,
) -> QueryPoints:
    """Thin a depth image to points in its level frame.

    Args:
        depth_m: depth z, m; 0 where nothing was measured.
        camera: intrinsics, scaled to the size of the depth image if they are of another size.
        R_level_camera: rotation from the camera's optical frame to the level frame.
        height_m: height of the camera above the ground, m.
        settings: of the blocks and points.
        noise: standard deviation of one pixel's inverse depth, 1/m; None estimates the total from the image.
        focal_baseline_px_m: focal length times baseline, px m. It only scales the unit of the disparity offset.
    """
    noise = inverse_depth_noise(depth_m).total if noise is None else noise
    blocks = blocks_of(depth_m, camera, settings, noise=noise)
    return points_from(blocks, R_level_camera, height_m, settings, noise=noise, focal_baseline_px_m=focal_baseline_px_m)


def points_from(
    blocks: DepthBlocks,
    R_level_camera: Rotation,
    height_m: float,
    settings: PointSettings,
    *,
    noise: float,
    focal_baseline_px_m: float,
) -> QueryPoints:
    """Convert the blocks of a depth image to points in its level frame.

    Args:
        blocks: of the depth image, as ``blocks_of`` returns them.
        R_level_camera: rotation from the camera's optical frame to the level frame.
        height_m: height of the camera above the ground, m.
        settings: of the blocks and points.
        noise: standard deviation of one pixel's inverse depth, 1/m.
        focal_baseline_px_m: focal length times baseline, px m. It only scales the unit of the disparity offset.
    """
    own, z = blocks.camera, blocks.z_m.ravel()
    kept = np.flatnonzero(z)
    z, (v, u) = z[kept], np.divmod(kept, own.width)
    rays = np.stack([(u - own.cx) / own.fx, (v - own.cy) / own.fy, np.ones(len(u))], axis=1)
    level: Float64[NDArray[np.float64], "n 3"] = rays @ R_level_camera.T
    xyz = z[:, None] * level
    chosen = _chosen(xyz[:, 2] + height_m < settings.ground_m, settings)
    xyz, z, level, length = xyz[chosen], z[chosen], level[chosen], np.linalg.norm(rays[chosen], axis=1)
    sigma = np.hypot(z**2 * noise * length, settings.floor_m)
    movable = _may_move(xyz[:, 2] + height_m, settings)
    f = np.float32
    return QueryPoints(
        xyz=xyz.astype(f),
        ray=(level / length[:, None]).astype(f),
        sigma=sigma.astype(f),
        weight=np.where(movable, settings.movable_weight, 1.0).astype(f),
        q=(z / focal_baseline_px_m).astype(f),
    )


def movable_of(
    blocks: DepthBlocks, R_level_camera: Rotation, height_m: float, settings: PointSettings
) -> Bool[NDArray[np.bool_], "H W"]:
    """Mark the blocks that may show dynamic objects: measured points between ``ground_m`` and ``movable_m`` above the ground.

    Args:
        blocks: of the depth image, as ``blocks_of`` returns them.
        R_level_camera: rotation from the camera's optical frame to the level frame.
        height_m: height of the camera above the ground, m.
        settings: of the blocks and points.
    """
    return _may_move(_above_ground_m(blocks, R_level_camera, height_m), settings) & (blocks.z_m > 0)


def below(blocks: DepthBlocks, R_level_camera: Rotation, height_m: float, highest_m: float) -> DepthBlocks:
    """Omit the blocks that lie higher above the ground than a limit.

    Args:
        blocks: of the depth image, as ``blocks_of`` returns them.
        R_level_camera: rotation from the camera's optical frame to the level frame.
        height_m: height of the camera above the ground, m.
        highest_m: limit, m above the ground.
    """
    kept = _above_ground_m(blocks, R_level_camera, height_m) <= highest_m
    return replace(blocks, z_m=np.where(kept, blocks.z_m, np.float32(0)))


def _above_ground_m(
    blocks: DepthBlocks, R_level_camera: Rotation, height_m: float
) -> Float64[NDArray[np.float64], "H W"]:
    """Return the height of each block above the ground, m; the camera's height where nothing was measured."""
    own = blocks.camera
    v, u = (np.arange(side)[of] for side, of in ((own.height, np.s_[:, None]), (own.width, np.s_[None])))
    x, y, z = R_level_camera[2]
    above_m: Float64[NDArray[np.float64], "H W"] = (
        blocks.z_m * (x * (u - own.cx) / own.fx + y * (v - own.cy) / own.fy + z) + height_m
    )
    return above_m


def _may_move(
    above_m: Float64[NDArray[np.float64], "*shape"], settings: PointSettings
) -> Bool[NDArray[np.bool_], "*shape"]:
    may: Bool[NDArray[np.bool_], "*shape"] = (above_m > settings.ground_m) & (above_m < settings.movable_m)
    return may


def _chosen(ground: Bool[NDArray[np.bool_], " n"], settings: PointSettings) -> NDArray[np.intp]:
    """Rows of evenly spread points, with at most ``ground_share`` of them on the ground."""
    above, below = np.flatnonzero(~ground), np.flatnonzero(ground)
    most_below = int(settings.ground_share * settings.points)
    above = _thinned(above, settings.points - min(len(below), most_below))
    limit = max(50, int(len(above) * settings.ground_share / (1 - settings.ground_share)))
    return np.concatenate([above, _thinned(below, min(most_below, limit))])


def _thinned(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    if len(rows) <= most:
        return rows
    thinned: NDArray[np.intp] = rows[np.linspace(0, len(rows) - 1, most).astype(np.intp)]
    return thinned
