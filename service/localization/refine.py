"""From similar views to a metric pose: register the depth from every distinct start and keep the best supported pose."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform, heading_of_camera
from service.maps.map import Map
from service.registration.covariance import (
    OF_POINTS,
    OF_RAYS,
    Stability,
    covariance_of,
    rectification_covariance,
    relative_pose_covariance,
    score_outer_product,
    survey_covariance,
    variance_inflation,
)
from service.registration.kernel import QueryPoints
from service.registration.local_search import LocalSearchSettings, search_locally
from service.registration.points import FOCAL_BASELINE_PX_M, PointSettings
from service.registration.rays import OFFSET_PX, RaySettings
from service.registration.register import Registered, RegistrationSettings, Start, register
from service.registration.restarts import RestartSettings, difference, spread_of_restarts
from service.registration.surfel_tiles import Cloud
from service.registration.visibility import Raycasters
from service.retrieval.prior import Prior
from service.retrieval.retrieve import EncodedFrame
from service.retrieval.starts import StartSettings, starts_from
from service.scoring.candidates import Candidate, Refined
from service.scoring.confirmation import Confirmation, confirm
from service.scoring.measured import MeasuredFrame, measure, merged_points
from service.scoring.photometry import BrightnessScorer, PhotometrySettings
from service.scoring.ray_evidence import RayPose, RayScorer
from service.scoring.similarity import similarity_of
from service.scoring.structure import StructureScorer
from service.scoring.support import LocalScoreWeights, PoseScorer, SupportWeights, scorers_of
from service.scoring.verifier import PoseVerifier

_Covariance = Float64[NDArray[np.float64], "6 6"]


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
        restarts: settings of the restarted ray adjustments, for the covariance.
        photometry: settings of the brightness comparison.
    """

    fewest_points: int = 30
    focal_baseline_px_m: float = FOCAL_BASELINE_PX_M
    support: SupportWeights = field(default_factory=SupportWeights)
    starts: StartSettings = field(default_factory=StartSettings)
    points: PointSettings = field(default_factory=PointSettings)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    around: LocalSearchSettings = field(default_factory=LocalSearchSettings)
    near: LocalScoreWeights = field(default_factory=LocalScoreWeights)
    rays: RaySettings = field(default_factory=RaySettings)
    restarts: RestartSettings = field(default_factory=RestartSettings)
    photometry: PhotometrySettings = field(default_factory=PhotometrySettings)


def settings_for_rig(settings: RefineSettings, focal_baseline_px_m: float) -> RefineSettings:
    """Return the settings for a known stereo rig: its disparity offset is estimated with a prior (``OFFSET_PX``).

    Args:
        settings: settings without a rig.
        focal_baseline_px_m: focal length (px) times baseline (m) of the rig.
    """
    registration = settings.registration
    return replace(
        settings,
        focal_baseline_px_m=focal_baseline_px_m,
        registration=replace(
            registration,
            middle=replace(registration.middle, free_offset=True, offset=OFFSET_PX),
            fine=replace(registration.fine, free_offset=True, offset=OFFSET_PX),
        ),
    )


def measured_frames(
    bundle: Map, frames: tuple[EncodedFrame, ...], settings: RefineSettings
) -> tuple[tuple[MeasuredFrame, ...], RefineSettings]:
    """Prepare the depth of image pairs; return it and the settings for their rig.

    Args:
        bundle: the map.
        frames: image pairs, the reference first.
        settings: settings of registration and scoring.
    """
    rig_px_m = frames[0].query.focal_baseline_px_m
    if rig_px_m is not None:
        settings = settings_for_rig(settings, rig_px_m)
    measured = measure(
        frames,
        settings.points,
        focal_baseline_px_m=settings.focal_baseline_px_m,
        is_rig=rig_px_m is not None,
        surveyed_height_m=bundle.manifest.surveyed_height_m,
    )
    return measured, settings


def refine(
    bundle: Map,
    cloud: Cloud,
    frames: tuple[EncodedFrame, ...],
    prior: Prior | None,
    settings: RefineSettings,
    verifier: PoseVerifier,
    predicted: tuple[Transform, ...] = (),
) -> Refined | None:
    """Register image pairs on the map cloud; return None if they have too few points.

    Args:
        bundle: the map.
        cloud: cloud of the map.
        frames: image pairs, the reference first.
        prior: prior of the reference pose; None if nothing is known.
        settings: settings of registration and scoring.
        verifier: network that compares a pose with the map.
        predicted: further starts T_map_camera of the reference, for example from odometry. They compete like all others.
    """
    reference = frames[0]
    # 1. Points of all frames, in the level frame of the reference.
    measured, settings = measured_frames(bundle, frames, settings)
    points = merged_points(measured)
    if len(points) < settings.fewest_points:
        return None
    # 2. Starts, and registration of each from coarse to fine.
    starts = _starts(bundle, measured, frames, prior, predicted, settings.starts)
    found = register(cloud, points, starts, reference.views.height_m, settings.registration)
    # 3. Scores, and other local minima around the best pose.
    raycasters = Raycasters(cloud, settings.rays)
    scorer = _scorer_of(bundle, cloud, raycasters, measured, prior, settings, verifier)
    candidates = scorer.with_details(scorer.candidates(found))
    independent = float(np.median([frame.independent_noise for frame in frames]))
    if scorer.brightness.is_known and independent >= settings.around.from_noise:
        at, height_m = candidates[0].registered, reference.views.height_m
        near = search_locally(cloud, points, at, height_m, settings.registration, settings.around)
        candidates[0] = scorer.select_local_optimum(candidates[0], near)
    # 4. Adjustment of the best pose along the rays, its comparison with poses next to it, and its covariance.
    noise = float(np.median([frame.noise for frame in frames]))
    final = _adjusted(cloud, raycasters, scorer, points, candidates[0], noise, settings)
    systematic = _systematic_covariance(bundle, frames)
    covariance = final.covariance + systematic
    candidates[0] = replace(
        candidates[0], T_map_camera=final.T_map_camera, registered=final.pose, covariance=covariance
    )

    def covariance_at(candidate: Candidate) -> _Covariance:
        pose = candidate.registered
        scatter_at = score_outer_product(cloud.at(pose.camera_m), points, pose, settings.registration)
        heading_at = heading_of_camera(candidate.T_map_camera)
        return covariance_of(pose.information, scatter_at, noise, heading_at, OF_POINTS) + systematic

    return Refined(
        candidates=tuple(candidates),
        covariance=covariance,
        registration_covariance=final.covariance,
        points=len(points),
        variance_inflation=variance_inflation(final.pose.information, final.scatter),
        confirmation=final.confirmation,
        ray_evidence=final.along.evidence,
        verified=final.along.verified,
        compared=scorer.rays.compared,
        covariance_at=covariance_at,
    )


def _scorer_of(
    bundle: Map,
    cloud: Cloud,
    raycasters: Raycasters,
    measured: tuple[MeasuredFrame, ...],
    prior: Prior | None,
    settings: RefineSettings,
    verifier: PoseVerifier,
) -> PoseScorer:
    """Return the scorer of the candidates of one query."""
    return PoseScorer(
        measured,
        scorers_of(bundle, cloud, measured, prior, settings.support),
        StructureScorer(cloud, measured, settings.support.structure),
        BrightnessScorer(raycasters, measured, settings.photometry),
        RayScorer(raycasters, measured, settings.rays, settings.support.rays, settings.photometry, verifier),
        settings.support,
        settings.near,
    )


def _systematic_covariance(bundle: Map, frames: tuple[EncodedFrame, ...]) -> _Covariance:
    """Return the covariance of errors that no residual shows: of the survey, the odometry and the rectification."""
    reference = frames[0]
    systematic = survey_covariance(*bundle.manifest.survey_std) + relative_pose_covariance(len(frames))
    if reference.query.baseline_m is not None:
        systematic = systematic + rectification_covariance(reference.views.height_m, reference.query.baseline_m)
    return systematic


@dataclass(frozen=True, slots=True, eq=False)
class _Adjusted:
    """The final pose, the scatter of its patches' gradients, its comparison with poses next to it and with the map, and its covariance.

    The covariance contains no systematic errors.
    """

    pose: Registered
    T_map_camera: Transform
    scatter: Float64[NDArray[np.float64], "8 8"]
    confirmation: Confirmation
    along: RayPose
    covariance: _Covariance


def _adjusted(
    cloud: Cloud,
    raycasters: Raycasters,
    scorer: PoseScorer,
    points: QueryPoints,
    candidate: Candidate,
    noise: float,
    settings: RefineSettings,
) -> _Adjusted:
    """Adjust the pose of a candidate along the rays. If too few rays intersect the map, it stays the pose of the points."""
    found, pictures = candidate.registered, [each.picture for each in scorer.measured]
    along = scorer.rays.at(found)
    pose, scatter = along.pose, along.scatter
    T_map_camera = scorer.measured[0].frame.pose_of_camera(pose.T_map_level)
    heading, confirmation = heading_of_camera(T_map_camera), confirm(cloud, scorer.structure, pose)
    if scatter is None:
        scatter = score_outer_product(cloud.at(pose.camera_m), points, pose, settings.registration)
        covariance = covariance_of(pose.information, scatter, noise, heading, OF_POINTS)
    else:
        raycaster = raycasters.at(found.camera_m)
        stability = Stability(
            restarts=spread_of_restarts(raycaster, pictures, pose, heading, settings.rays, settings.restarts),
            shift=difference(pose.T_map_level, found.T_map_level),
            mapped_inliers=candidate.mapped_inliers,
            along_residual=confirmation.along_residual,
        )
        covariance = covariance_of(pose.information, scatter, noise, heading, OF_RAYS, stability)
    return _Adjusted(pose, T_map_camera, scatter, confirmation, along, covariance)


def _starts(
    bundle: Map,
    measured: tuple[MeasuredFrame, ...],
    frames: tuple[EncodedFrame, ...],
    prior: Prior | None,
    predicted: tuple[Transform, ...],
    settings: StartSettings,
) -> list[Start]:
    """Return the starts at similar views, and at the predicted poses T_map_camera of the reference."""
    starts = starts_from(
        frames,
        prior,
        lidar_height_m=bundle.manifest.lidar_height_m,
        settings=settings,
        similarity_at=None if len(frames) == 1 else lambda T_map_level: similarity_of(bundle, measured, T_map_level)[0],
    )
    if not predicted:
        return starts
    T_map_level = np.stack([frames[0].pose_of_level(T) for T in predicted])
    similarity, _ = similarity_of(bundle, measured, T_map_level)
    return starts + [
        Start(T[:3, :3], T[:3, 3], len(starts) + k, float(cosine))
        for k, (T, cosine) in enumerate(zip(T_map_level, similarity, strict=True))
    ]
