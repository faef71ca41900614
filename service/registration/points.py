"""From a depth picture to the points that are registered, each with its uncertainty.

A triangulating camera errs by a share of its disparity, so by the square of the distance; how much is read off the picture
itself: on a plane the inverse depth is linear in the pixel, so what its second difference leaves is noise.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation
from service.registration.kernel import QueryPoints


@dataclass(frozen=True, slots=True, kw_only=True)
class PointSettings:
    """How a picture is thinned to points. Ours, November 2026.

    Attributes:
        columns: blocks across the picture; a block gives one point, its median.
        points: at most this many.
        ground_share: largest share of points of the ground, which says nothing about where along it one stands.
        ground_m: points lower than this above the ground are of the ground.
        edge: a block whose inverse depths spread by more than this share lies on an edge.
        correlated: noise variance that neighbours share, in units of what differs from pixel to pixel.
        floor_m: no range is known better.
        reach_m: points further away are left out.
        movable_m: lower than this above the ground stand vehicles and people, which may have come or gone since the survey;
        movable_weight: so points there count for less, the ground's apart.
    """

    columns: int = 128
    points: int = 3000
    ground_share: float = 0.25
    ground_m: float = 0.3
    edge: float = 0.12
    correlated: float = 0.0
    floor_m: float = 0.02
    reach_m: float = 40.0
    movable_m: float = 2.0
    movable_weight: float = 0.1

    def __post_init__(self) -> None:
        """Refuse a share that would leave no point above the ground."""
        if not 0 <= self.ground_share < 1:
            raise ValueError(f"ground_share: {self.ground_share:g} is not at least 0 and less than 1")


def inverse_depth_noise(depth_m: Float32[NDArray[np.float32], "H W"]) -> float:
    """Standard deviation of one pixel's inverse depth, 1/m: from second differences along rows."""
    picture = depth_m[::4]
    valid = picture > 0
    inverse = np.where(valid, 1.0 / np.where(valid, picture, 1), 0).astype(np.float32)
    step = 2  # neighbours at one pixel may have been smoothed together
    second = inverse[:, : -2 * step] - 2 * inverse[:, step:-step] + inverse[:, 2 * step :]
    known = valid[:, : -2 * step] & valid[:, step:-step] & valid[:, 2 * step :]
    if known.sum() < 100:
        return 0.25 / 80.0
    return float(1.4826 * np.median(np.abs(second[known])) / np.sqrt(6.0))


def points_of(
    depth_m: Float32[NDArray[np.float32], "H W"], camera: PinholeCamera, R_level_camera: Rotation, height_m: float,
    settings: PointSettings, *, noise: float | None = None, focal_baseline_px_m: float = 80.0,
) -> QueryPoints:  # fmt: skip
    """Thin a depth picture to points of its level frame.

    Args:
        depth_m: z, metres, 0 where nothing was measured.
        camera: of the same aspect.
        R_level_camera: from the optical to the level frame.
        height_m: of the camera above the ground.
        settings: how many, and which.
        noise: standard deviation of one pixel's inverse depth, 1/m; read off the picture where it is not given.
        focal_baseline_px_m: of the camera; only scales the unit of the disparity offset.
    """
    height, width = depth_m.shape
    own = camera if (camera.height, camera.width) == (height, width) else camera.scaled_to(width, height)
    size = max(1, width // settings.columns)
    rows, columns = height // size, width // size
    skip = max(1, size // 4)
    blocks = depth_m[: rows * size, : columns * size].reshape(rows, size, columns, size)[:, ::skip, :, ::skip]
    samples = np.ascontiguousarray(blocks.transpose(0, 2, 1, 3)).reshape(rows * columns, -1)
    valid = samples > 0
    count = valid.sum(axis=1)
    inverse = np.where(valid, 1.0 / np.where(valid, samples, 1), np.inf).astype(np.float32)
    inverse.sort(axis=1)
    enough = count >= max(1, (samples.shape[1] + 1) // 2)
    at = np.arange(len(inverse))
    pick = [inverse[at, np.maximum((share * (count - 1)).astype(int), 0)] for share in (0.1, 0.5, 0.9)]
    # The median of an even number lies between the two middle ones: the lower alone would push every surface away.
    pick[1] = 0.5 * (pick[1] + inverse[at, np.maximum(count // 2, 0)])
    low, middle, high = (np.where(enough, p, 1.0) for p in pick)
    noise = inverse_depth_noise(depth_m) if noise is None else noise
    spread = (high - low) - 2.56 * noise
    z = (1.0 / middle).astype(np.float32)
    keep = enough & (spread < settings.edge * middle) & (z < settings.reach_m)
    v, u = np.divmod(at, columns)
    centre_px = float(np.arange(0, size, skip).mean())  # of the pixels that were read, not of the block
    u, v = u * size + centre_px, v * size + centre_px
    rays = np.stack([(u - own.cx) / own.fx, (v - own.cy) / own.fy, np.ones(len(u))], axis=1)
    length = np.linalg.norm(rays, axis=1)
    sigma = np.hypot(z**2 * noise * np.sqrt(1 + settings.correlated) * length, settings.floor_m)
    level: Float64[NDArray[np.float64], "n 3"] = rays @ R_level_camera.T
    chosen = _chosen(np.flatnonzero(keep), z[:, None] * level, height_m, settings)
    f = np.float32
    above_m = z[chosen] * level[chosen, 2] + height_m
    movable = (above_m > settings.ground_m) & (above_m < settings.movable_m)
    return QueryPoints(
        xyz=(z[:, None] * level)[chosen].astype(f), ray=(level / length[:, None])[chosen].astype(f), sigma=sigma[chosen].astype(f),
        weight=np.where(movable, settings.movable_weight, 1.0).astype(f), q=(z / focal_baseline_px_m)[chosen].astype(f),
    )  # fmt: skip


def _chosen(
    rows: NDArray[np.intp], xyz: Float64[NDArray[np.float64], "n 3"], height_m: float, settings: PointSettings
) -> NDArray[np.intp]:
    """Evenly spread rows, the ground's at most their share."""
    ground = xyz[rows, 2] + height_m < settings.ground_m
    above, below = rows[~ground], rows[ground]
    most_below = int(settings.ground_share * settings.points)
    above = _thinned(above, settings.points - min(len(below), most_below))
    limit = max(50, int(len(above) * settings.ground_share / (1 - settings.ground_share)))
    return np.concatenate([above, _thinned(below, min(most_below, limit))])


def _thinned(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    if len(rows) <= most:
        return rows
    thinned: NDArray[np.intp] = rows[np.linspace(0, len(rows) - 1, most).astype(np.intp)]
    return thinned
