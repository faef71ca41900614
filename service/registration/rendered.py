"""Does the map, drawn as the camera would see it from a pose, agree with what the camera saw?

Points in front of the mapped surface are natural: something stands there now. Points behind it are not: the camera would have
looked through a wall. The share of inliers knows neither, since it asks only for the nearest surface.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, transform_from
from service.registration.kernel import QueryPoints, render
from service.registration.register import Registered
from service.registration.surfel_map import TILE_M, SurfelMap

WIDTH = 80  # of the picture drawn, pixels
SURFEL_M = 0.4
REACH_M = 45.0
_NOTHING_M = 60.0  # where the map shows no surface, one is taken to be that far
#: Shares of a beam model (Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 6.3): the mapped surface is hit, something
#: new stands before it, something is gone, anything. Chosen on the watch cities.
_HIT, _NEW, _GONE, _ANY = 0.6, 0.25, 0.02, 0.05
_ROUGH_M, _SPAN_M = 0.15, 40.0
_CERTAIN, _MARGIN_M = 3.0, 0.25  # standard deviations and metres beyond which a point lies off the surface


@dataclass(frozen=True, slots=True)
class Agreement:
    """Of a query with the map as drawn at a pose.

    Attributes:
        likelihood: mean logarithm of the beam model's density, 1/m.
        through: share of the points seen behind mapped surfaces.
        front: share in front of them.
        unmapped: share where the map shows nothing.
    """

    likelihood: float
    through: float
    front: float
    unmapped: float

    @staticmethod
    def mean(of: list["Agreement"]) -> "Agreement":
        """Of several pictures of one pose, at least one."""
        return Agreement(*(float(np.mean([getattr(each, name) for each in of])) for name in Agreement.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Points of a query as pixels of the small picture that the map is drawn on; the same for every pose.

    Attributes:
        camera: of the small picture.
        R_level_camera: of the query's level.
        row: of each point.
        column: of each point.
        z: depth of each, metres, as measured.
        sigma: its standard deviation, metres.
        q: as in ``QueryPoints``.
    """

    camera: PinholeCamera
    R_level_camera: Rotation
    row: NDArray[np.intp]
    column: NDArray[np.intp]
    z: Float64[NDArray[np.float64], " n"]
    sigma: Float64[NDArray[np.float64], " n"]
    q: Float32[NDArray[np.float32], " n"]

    def __len__(self) -> int:
        return len(self.z)


def seen_by(points: QueryPoints, camera: PinholeCamera, R_level_camera: Rotation) -> Seen:
    """Prepare a query for ``agreement``.

    Args:
        points: of the query, its level frame.
        camera: of the query.
        R_level_camera: of the query's level.
    """
    small = camera.scaled_to(WIDTH, max(1, round(WIDTH * camera.height / camera.width)))
    optical: Float64[NDArray[np.float64], "n 3"] = points.xyz @ R_level_camera
    z = optical[:, 2]
    column = np.rint(optical[:, 0] / z * small.fx + small.cx).astype(np.intp).clip(0, small.width - 1)
    row = np.rint(optical[:, 1] / z * small.fy + small.cy).astype(np.intp).clip(0, small.height - 1)
    return Seen(small, R_level_camera, row, column, z, points.sigma * (points.ray @ R_level_camera[:, 2]), points.q)


def agreement(cloud: SurfelMap, seen: Seen, candidate: Registered) -> Agreement:
    """Draw the map at a candidate's pose and compare.

    Args:
        cloud: the map's.
        seen: the query.
        candidate: the pose.
    """
    T = transform_from(candidate.R_map_level @ seen.R_level_camera, candidate.camera_m - cloud.origin_m)
    drawn = render(
        cloud.surfels, cloud.tiles, tile_m=TILE_M, T_map_camera=T, camera=seen.camera, size_m=SURFEL_M, reach_m=REACH_M
    )
    z = seen.z * candidate.scale / (1.0 + candidate.offset * seen.q)
    nearest, mapped, furthest = (each[seen.row, seen.column] for each in _around(drawn))
    unmapped = nearest >= _NOTHING_M
    spread = np.hypot(seen.sigma, _ROUGH_M)
    hit = np.exp(-0.5 * ((z - mapped) / spread) ** 2) / (np.sqrt(2 * np.pi) * spread)
    density = _HIT * hit + _NEW * (z < mapped) / np.maximum(mapped, 2.0) + (_GONE * (z > mapped) + _ANY) / _SPAN_M
    off = _CERTAIN * seen.sigma + _MARGIN_M
    return Agreement(
        likelihood=float(np.log(density).mean()), through=float((~unmapped & (z > furthest + off)).mean()),
        front=float((~unmapped & (z < nearest - off)).mean()), unmapped=float(unmapped.mean()),
    )  # fmt: skip


def _around(
    drawn: Float32[NDArray[np.float32], "h w"],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """At each pixel: the least depth of it and its eight neighbours, its own, the greatest."""
    depth = np.pad(np.where(drawn > 0, drawn, np.float32(_NOTHING_M)), 1, mode="edge")
    across = np.stack([depth[:, :-2], depth[:, 1:-1], depth[:, 2:]])
    low, high = across.min(axis=0), across.max(axis=0)
    low = np.minimum(np.minimum(low[:-2], low[1:-1]), low[2:])
    high = np.maximum(np.maximum(high[:-2], high[1:-1]), high[2:])
    return low, depth[1:-1, 1:-1], high
