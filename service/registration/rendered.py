"""Does the map, drawn as the camera would see it from a pose, agree with what the camera saw?

Points in front of the mapped surface are natural: something stands there now. Points behind it are not: the camera would have
looked through a wall. The share of inliers knows neither, since it asks only for the nearest surface.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, transform_from
from service.registration.kernel import BeamModel, QueryPoints, agree, render
from service.registration.register import Registered
from service.registration.surfel_map import TILE_M, SurfelMap

WIDTH = 80  # of the picture drawn, pixels
SURFEL_M = 0.4
REACH_M = 45.0
#: Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 6.3. Chosen on the watch cities.
_BEAM = BeamModel(
    hit=0.6, new=0.25, gone=0.02, any=0.05, rough_m=0.15, span_m=40.0, certain=3.0, margin_m=0.25, nothing_m=60.0
)


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
        pixel: of each point, row by row.
        z: depth of each, metres, as measured.
        sigma: its standard deviation, metres.
        q: as in ``QueryPoints``.
    """

    camera: PinholeCamera
    R_level_camera: Rotation
    pixel: Int32[NDArray[np.int32], " n"]
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
    pixel = (row * small.width + column).astype(np.int32)
    sigma = (points.sigma * (points.ray @ R_level_camera[:, 2])).astype(np.float64)
    return Seen(small, R_level_camera, pixel, z.astype(np.float64), sigma, points.q)


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
    likelihood, through, front, unmapped = agree(
        drawn, seen.pixel, seen.z, seen.sigma, seen.q, _BEAM, scale=candidate.scale, offset=candidate.offset
    )
    return Agreement(likelihood, through, front, unmapped)
