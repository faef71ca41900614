"""Score poses by rendered depth: compare the measured depth with the depth that the map shows from a pose.

Points in front of the mapped surface are plausible: an object stands there now. Points behind it are not: the camera would have
looked through a wall. The share of inliers detects neither, because it uses only the nearest surface.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, transform_from
from service.registration.kernel import BeamModel, QueryPoints, consistency, render
from service.registration.register import Registered
from service.registration.surfel_tiles import Cloud, Surfels
from service.scoring.measured import MeasuredFrame
from service.scoring.scorer import Scores

#: Width of the rendered image, px.
WIDTH = 80
#: Edge of the square that represents a surfel, m.
SURFEL_M = 0.4
#: Largest rendered depth, m.
REACH_M = 45.0
#: Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 6.3. Chosen on the validation cities.
_BEAM = BeamModel(
    hit=0.6,
    new=0.25,
    removed=0.02,
    outlier=0.05,
    roughness_m=0.15,
    span_m=40.0,
    threshold_sigmas=3.0,
    margin_m=0.25,
    unmapped_m=60.0,
)


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of a query's depth with the map rendered at a pose.

    Attributes:
        likelihood: mean logarithm of the beam model's density (1/m).
        through: share of the points behind the mapped surfaces.
        front: share of the points in front of the mapped surfaces.
        unmapped: share of the points where the map shows no surface.
    """

    likelihood: float
    through: float
    front: float
    unmapped: float

    @staticmethod
    def mean(of: list["Agreement"]) -> "Agreement":
        """Average the agreement of several images of one pose.

        Args:
            of: agreement of each image, at least one.
        """
        return Agreement(*(float(np.mean([getattr(each, name) for each in of])) for name in Agreement.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedPoints:
    """Points of a query, projected into the small image that the map is rendered to; the same for every pose.

    Attributes:
        camera: intrinsics of the small image.
        R_level_camera: rotation from the camera's optical frame to the query's level frame.
        pixel: index of each point's pixel, counted row by row.
        z: measured depth of each point along the optical axis, m.
        sigma: standard deviation of ``z``, m.
        q: as in ``QueryPoints``, 1/px.
    """

    camera: PinholeCamera
    R_level_camera: Rotation
    pixel: Int32[NDArray[np.int32], " n"]
    z: Float64[NDArray[np.float64], " n"]
    sigma: Float64[NDArray[np.float64], " n"]
    q: Float32[NDArray[np.float32], " n"]

    def __len__(self) -> int:
        return len(self.z)


def project_points(points: QueryPoints, camera: PinholeCamera, R_level_camera: Rotation) -> ProjectedPoints:
    """Project the points of a query for ``agreement``.

    Args:
        points: of the query, in its level frame.
        camera: intrinsics of the query.
        R_level_camera: rotation from the camera's optical frame to the query's level frame.
    """
    small = camera.scaled_to(WIDTH, max(1, round(WIDTH * camera.height / camera.width)))
    optical: Float64[NDArray[np.float64], "n 3"] = points.xyz @ R_level_camera
    z = optical[:, 2]
    column = np.rint(optical[:, 0] / z * small.fx + small.cx).astype(np.intp).clip(0, small.width - 1)
    row = np.rint(optical[:, 1] / z * small.fy + small.cy).astype(np.intp).clip(0, small.height - 1)
    pixel = (row * small.width + column).astype(np.int32)
    sigma = (points.sigma * (points.ray @ R_level_camera[:, 2])).astype(np.float64)
    return ProjectedPoints(small, R_level_camera, pixel, z.astype(np.float64), sigma, points.q)


def agreement(cloud: Surfels, projected: ProjectedPoints, candidate: Registered) -> Agreement:
    """Render the map at a candidate's pose and compare the query's depth with it.

    Args:
        cloud: surfels around the pose.
        projected: projected points of the query.
        candidate: the registered pose, map frame.
    """
    T = transform_from(candidate.R_map_level @ projected.R_level_camera, candidate.camera_m - cloud.origin_m)
    rendered = render(
        cloud.pieces,
        T_map_camera=T,
        camera=projected.camera,
        size_m=SURFEL_M,
        reach_m=REACH_M,
    )
    likelihood, through, front, unmapped = consistency(
        rendered,
        projected.pixel,
        projected.z,
        projected.sigma,
        projected.q,
        _BEAM,
        scale=candidate.scale,
        offset=candidate.offset,
    )
    return Agreement(likelihood, through, front, unmapped)


class RenderedDepthScorer:
    """Scorer by the mean log likelihood of a query's depth, given the rendered map.

    Args:
        cloud: cloud of the map.
        measured: frames of the query, the reference first.
    """

    name = "likelihood"

    def __init__(self, cloud: Cloud, measured: tuple[MeasuredFrame, ...]) -> None:
        self._cloud, self._measured = cloud, [each for each in measured if len(each.points)]
        self._projected = [
            project_points(each.points, each.frame.query.camera, each.frame.R_level_camera) for each in self._measured
        ]

    def score(self, poses: tuple[Registered, ...]) -> Scores:
        """Return the likelihood at each pose; details are the shares ``through``, ``front`` and ``unmapped`` of ``Agreement``.

        Args:
            poses: one or more registered poses of the reference's level frame.
        """
        found = [self._agreement(pose) for pose in poses]
        likelihood, *shares = (np.array([getattr(each, name) for each in found]) for name in Agreement.__slots__)
        return Scores(likelihood, dict(zip(Agreement.__slots__[1:], shares, strict=True)))

    def _agreement(self, pose: Registered) -> Agreement:
        """Mean over all frames that have points."""
        found = []
        for each, projected in zip(self._measured, self._projected, strict=True):
            own = each.pose(pose)
            found.append(agreement(self._cloud.at(own.camera_m), projected, own))
        return Agreement.mean(found)
