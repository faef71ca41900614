"""From similar views to a metric pose: register the depth from every distinct start and keep the best supported pose."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import heading_of_camera, transform_from
from service.localization.frames import Frame
from service.localization.prior import Prior
from service.localization.rivals import distinct_candidates
from service.localization.scoring import Candidate, LocalScoreWeights, PoseScorer, SupportWeights
from service.localization.similar import similarities_at
from service.localization.starts import Likeness, StartSettings, level_from, starts_from
from service.maps.reader import MapBundle
from service.registration.covariance import OF_POINTS, OF_RAYS, covariance_of
from service.registration.kernel import QueryPoints
from service.registration.local_search import LocalSearchSettings, search_locally
from service.registration.photometry import PhotometrySettings
from service.registration.points import DepthBlocks, PointSettings, blocks_of, movable_of, points_from
from service.registration.rays import RayPicture, RaySettings, adjust, picture_of
from service.registration.register import RegistrationSettings, register
from service.registration.rendered import project_points
from service.registration.scatter import disagreement, score_outer_product
from service.registration.surfel_map import SurfelMap
from service.registration.visibility import SurfelRaycaster


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineSettings:
    """Settings of registration and scoring. Our own choice, November 2026.

    Attributes:
        fewest_points: smallest number of points, over all frames, to register.
        focal_baseline_px_m: focal length (px) times baseline (m) of the stereo rig. It converts a disparity offset to inverse depth.
        support: weights of the support.
        starts: settings of the starts.
        points: settings of the thinning of a depth image to points.
        registration: settings of the solver.
        around: settings of the local search around the best candidate.
        near: weights for the choice among poses of the local search.
        rays: settings of the ray adjustment.
        photometry: settings of the brightness comparison.
    """

    fewest_points: int = 30
    focal_baseline_px_m: float = 80.0
    support: SupportWeights = field(default_factory=SupportWeights)
    starts: StartSettings = field(default_factory=StartSettings)
    points: PointSettings = field(default_factory=PointSettings)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    around: LocalSearchSettings = field(default_factory=LocalSearchSettings)
    near: LocalScoreWeights = field(default_factory=LocalScoreWeights)
    rays: RaySettings = field(default_factory=RaySettings)
    photometry: PhotometrySettings = field(default_factory=PhotometrySettings)


def settings_for_rig(settings: RefineSettings, focal_baseline_px_m: float) -> RefineSettings:
    """Return the settings for a known stereo rig: its disparity offset is estimated with a prior (``OFFSET_PX``).

    Args:
        settings: settings without a rig.
        focal_baseline_px_m: focal length (px) times baseline (m) of the rig.
    """
    registration = settings.registration
    return replace(
        settings, focal_baseline_px_m=focal_baseline_px_m,
        registration=replace(
            registration, middle=replace(registration.middle, free_offset=True, offset=OFFSET_PX),
            fine=replace(registration.fine, free_offset=True, offset=OFFSET_PX),
        ),
    )  # fmt: skip


#: Standard deviation of a rig's disparity offset, px. With SGBM the offset was 0.1 to 0.46 px on real frames (feasibility study).
OFFSET_PX = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Result of registration.

    Attributes:
        candidates: registered poses, the best supported first.
        covariance: of the best candidate: translation (m), then rotation (rad), in map axes, about the camera.
        points: number of registered points, over all frames.
        disagreement: variance inflation at the best pose: how much the image patches disagree about it, relative to their noise.
        covariance_at: function that computes the covariance of a candidate without ray adjustment: of every one but the best.
    """

    candidates: tuple[Candidate, ...]
    covariance: Float64[NDArray[np.float64], "6 6"]
    points: int
    disagreement: float
    covariance_at: Callable[[Candidate], Float64[NDArray[np.float64], "6 6"]]

    @property
    def best(self) -> Candidate:
        """The best supported candidate."""
        return self.candidates[0]

    def with_covariances(self) -> tuple[Candidate, ...]:
        """Return all candidates, with a covariance for each of those that exclude each other.

        A covariance takes about 0.5 ms. So only answers that are not LOCALIZED need this method.
        """
        distinct = {id(each) for each in distinct_candidates(self.candidates)}
        return tuple(
            replace(each, covariance=self.covariance_at(each))
            if id(each) in distinct and each.covariance is None
            else each
            for each in self.candidates
        )


def refine(
    bundle: MapBundle, cloud: SurfelMap, frames: tuple[Frame, ...], prior: Prior | None, settings: RefineSettings
) -> Refined | None:
    """Register image pairs on the map cloud; return None if they have too few points.

    Args:
        bundle: the map.
        cloud: surfels of the map.
        frames: image pairs, the reference first.
        prior: prior of the reference pose; None if nothing is known.
        settings: settings of registration and scoring.
    """
    reference = frames[0]
    rig_px_m = reference.query.focal_baseline_px_m
    if rig_px_m is not None:
        settings = settings_for_rig(settings, rig_px_m)
    blocks = [blocks_of(f.query.depth_m, f.query.camera, settings.points, noise=f.noise) for f in frames]
    each = [_points(frame, own, settings) for frame, own in zip(frames, blocks, strict=True)]
    merged = each[0] if len(each) == 1 else _merged(frames, each)
    seen = [
        project_points(points, frame.query.camera, frame.R_level_camera)
        for frame, points in zip(frames, each, strict=True)
    ]
    if len(merged) < settings.fewest_points:
        return None
    starts = starts_from(
        frames, prior, lidar_height_m=bundle.manifest.lidar_height_m, settings=settings.starts,
        likeness=None if len(frames) == 1 else _likeness(bundle, frames),
    )  # fmt: skip
    found = register(cloud, merged, starts, reference.views.height_m, settings.registration)
    pictures = _pictures(frames, blocks, settings)
    sights = SurfelRaycaster(cloud, settings.rays)
    scorer = PoseScorer(
        bundle, sights, frames, seen, blocks, pictures, prior, settings.support, settings.near, settings.photometry
    )
    candidates = scorer.with_brightness(scorer.candidates(found))
    noise = float(np.median([frame.noise for frame in frames]))
    independent = float(np.median([frame.independent_noise for frame in frames]))
    if cloud.brightness is not None and independent >= settings.around.from_noise:
        near = search_locally(
            cloud, merged, candidates[0].registered, reference.views.height_m, settings.registration, settings.around
        )
        candidates[0] = scorer.select_local_optimum(candidates[0], near)
    best = candidates[0].registered
    adjusted = adjust(sights, pictures, best, settings.rays)
    if adjusted is None:
        scatter, model = score_outer_product(cloud, merged, best, settings.registration), OF_POINTS
    else:
        (best, scatter), model = adjusted, OF_RAYS
        T_map_camera = transform_from(best.R_map_level @ reference.R_level_camera, best.camera_m)
        candidates[0] = replace(candidates[0], T_map_camera=T_map_camera, registered=best)
    heading = heading_of_camera(candidates[0].T_map_camera)
    covariance = covariance_of(best.information, scatter, noise, heading, model)
    candidates[0] = replace(candidates[0], covariance=covariance)

    def covariance_at(candidate: Candidate) -> Float64[NDArray[np.float64], "6 6"]:
        pose = candidate.registered
        pulled = score_outer_product(cloud, merged, pose, settings.registration)
        return covariance_of(pose.information, pulled, noise, heading_of_camera(candidate.T_map_camera), OF_POINTS)

    return Refined(tuple(candidates), covariance, len(merged), disagreement(best.information, scatter), covariance_at)


def _points(frame: Frame, blocks: DepthBlocks, settings: RefineSettings) -> QueryPoints:
    return points_from(
        blocks, frame.R_level_camera, frame.views.height_m, settings.points, noise=frame.noise,
        focal_baseline_px_m=settings.focal_baseline_px_m,
    )  # fmt: skip


def _pictures(frames: tuple[Frame, ...], blocks: list[DepthBlocks], settings: RefineSettings) -> list[RayPicture]:
    """Build the inverse depth image of every frame, with its camera pose in the reference's level frame."""
    rig = None if frames[0].query.baseline_m is None else settings.focal_baseline_px_m
    pictures = []
    for frame, own in zip(frames, blocks, strict=True):
        T = level_from(frame.T_reference_camera, frame.R_level_camera, frames[0].R_level_camera)
        T_level_camera = T @ transform_from(frame.R_level_camera, np.zeros(3))
        movable = movable_of(own, frame.R_level_camera, frame.views.height_m, settings.points)
        pictures.append(picture_of(own, T_level_camera, noise=frame.noise, focal_baseline_px_m=rig, movable=movable))
    return pictures


def _merged(frames: tuple[Frame, ...], each: list[QueryPoints]) -> QueryPoints:
    """Transform the points of all frames to the reference's level frame and join them."""
    xyz, ray = [], []
    for frame, points in zip(frames, each, strict=True):
        T = level_from(frame.T_reference_camera, frame.R_level_camera, frames[0].R_level_camera).astype(np.float32)
        xyz.append(points.xyz @ T[:3, :3].T + T[:3, 3])
        ray.append(points.ray @ T[:3, :3].T)
    rest = (np.concatenate([getattr(points, name) for points in each]) for name in ("sigma", "weight", "q"))
    return QueryPoints(np.concatenate(xyz), np.concatenate(ray), *rest)


def _likeness(bundle: MapBundle, frames: tuple[Frame, ...]) -> Likeness:
    """Return a function from poses of the reference's level frame to the mean similarity over all frames."""

    def likeness(T_map_level: NDArray[np.float64]) -> NDArray[np.float64]:
        found = []
        for frame in frames:
            T = T_map_level @ level_from(frame.T_reference_camera, frame.R_level_camera, frames[0].R_level_camera)
            found.append(similarities_at(bundle, frame.descriptors, R_map_level=T[:, :3, :3], camera_m=T[:, :3, 3])[0])
        mean: NDArray[np.float64] = np.mean(found, axis=0)
        return mean

    return likeness
