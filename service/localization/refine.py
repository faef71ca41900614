"""From similar views to a metric pose: register the depth picture from every distinct one and keep the best supported."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, Transform, transform_from
from service.localization.search import ViewMatches
from service.localization.starts import StartSettings, starts_from
from service.registration.covariance import covariance_of
from service.registration.points import PointSettings, points_of
from service.registration.register import Registered, RegistrationSettings, register
from service.registration.surfel_map import SurfelMap


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineSettings:
    """Ours, November 2026.

    Attributes:
        fewest_points: a picture with fewer has nothing to register.
        similarity_weight: of the similarity against the share of inliers, when candidates are compared: a wrong street can
            fit as well as the right one whose parked cars have changed.
    """

    fewest_points: int = 30
    similarity_weight: float = 1.0
    starts: StartSettings = field(default_factory=StartSettings)
    points: PointSettings = field(default_factory=PointSettings)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """The pose, its covariance (6 x 6, translation first, map axes, about the camera), and all candidates, the best first."""

    T_map_camera: Transform
    covariance: Float64[NDArray[np.float64], "6 6"]
    candidates: tuple[Registered, ...]


def refine(
    cloud: SurfelMap, depth_m: Float32[NDArray[np.float32], "h w"], camera: PinholeCamera, matches: ViewMatches, *,
    R_level_camera: Rotation, height_m: float, lidar_height_m: float, settings: RefineSettings,
) -> Refined | None:  # fmt: skip
    """Register a query; None where its picture has too few points.

    Args:
        cloud: the map's.
        depth_m: z, metres; 0 where nothing was measured.
        camera: of the same aspect.
        matches: the most similar views, the best first.
        R_level_camera: of the query's level.
        height_m: of the camera above the ground.
        lidar_height_m: of the map's places above theirs.
        settings: how many starts, points and refinements.
    """
    points = points_of(depth_m, camera, R_level_camera, height_m, settings.points)
    if len(points) < settings.fewest_points:
        return None
    starts, similarities = starts_from(
        matches, height_m=height_m, lidar_height_m=lidar_height_m, settings=settings.starts
    )
    found = register(cloud, points, starts, height_m, settings.registration)
    support = [each.inliers + settings.similarity_weight * similarities[each.hypothesis] for each in found]
    ranked = tuple(found[k] for k in np.argsort(-np.array(support), kind="stable"))
    best = ranked[0]
    return Refined(
        transform_from(best.R_map_level @ R_level_camera, best.camera_m), covariance_of(best.information), ranked
    )
