"""Which of some registered poses is right: what the descriptors, the drawn map's depth and its brightness say of each."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform, transform_from
from service.localization.frames import Frame
from service.localization.prior import Prior
from service.localization.similar import similarities_at
from service.localization.starts import level_from
from service.maps.reader import MapBundle
from service.registration.around import Near
from service.registration.photometry import PhotometrySettings, agreement_of_brightness, grey_of
from service.registration.points import DepthBlocks
from service.registration.rays import RayPicture, met_by
from service.registration.register import Registered
from service.registration.rendered import Agreement, Seen, agreement
from service.registration.sight import Sights


@dataclass(frozen=True, slots=True, kw_only=True)
class SupportWeights:
    """What speaks for a candidate against its rivals, in nats: a conditional logit over the candidates of the watch cities' queries.

    ``brightness`` is asked only of candidates that are at most ``behind`` behind the best without it: drawing costs time.
    """

    inliers: float = 20.0
    similarity: float = 68.0
    likelihood: float = 2.4
    brightness: float = 80.0
    behind: float = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NearWeights:
    """What speaks for one of some poses a metre apart: a conditional logit over poses around a watch city's answers.

    So near each other they resemble the same places, which say nothing then, and brightness says more than between two streets.

    Attributes:
        still: share of inliers among the points of what cannot have moved.
        brightness: agreement of patches.
        stay: what speaks for the pose that was found first.
    """

    still: float = 45.0
    brightness: float = 300.0
    stay: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A registered pose and what speaks for it.

    Attributes:
        T_map_camera: of the reference camera.
        registered: as the solver left it; the best one adjusted along its rays, by centimetres, after all below was told.
        similarity: to the places around the pose, mean over the frames.
        place_m: how far those places are, mean over the frames.
        agreement: with the map as drawn at the pose, mean over the frames.
        support: logarithm, against the other candidates.
        covariance: of ``T_map_camera`` if the candidate is right, translation first, map axes, about the camera; None: not computed.
    """

    T_map_camera: Transform
    registered: Registered
    similarity: float
    place_m: float
    agreement: Agreement
    support: float
    covariance: Float64[NDArray[np.float64], "6 6"] | None = None


@dataclass(frozen=True, eq=False)
class Judge:
    """One question's pictures, ready to be compared with the map at any pose.

    Attributes:
        bundle: the map.
        sights: what rays meet of its prepared cloud.
        frames: the reference first.
        seen: points of each frame, for drawing.
        blocks: of each frame's depth.
        pictures: of each frame's rays.
        prior: of the reference's pose, if anything is known.
        weights: of the evidence.
        near: of that among poses a metre apart.
        photometry: how brightness is compared.
    """

    bundle: MapBundle
    sights: Sights
    frames: tuple[Frame, ...]
    seen: list[Seen]
    blocks: list[DepthBlocks]
    pictures: list[RayPicture]
    prior: Prior | None
    weights: SupportWeights
    near: NearWeights
    photometry: PhotometrySettings

    def candidates(self, found: tuple[Registered, ...]) -> list[Candidate]:
        """The poses with what speaks for each, brightness apart; the best supported first."""
        similarities, places_m = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
        for frame in self.frames:
            own = [self._of(frame, pose) for pose in found]
            similarity, place_m = similarities_at(
                self.bundle, frame.descriptors, R_map_level=np.stack([pose.R_map_level for pose in own]),
                camera_m=np.stack([pose.camera_m for pose in own]),
            )  # fmt: skip
            similarities.append(similarity)
            places_m.append(place_m)
        candidates = []
        for pose, similarity, place_m in zip(
            found, np.mean(similarities, axis=0), np.mean(places_m, axis=0), strict=True
        ):
            agreed = self.agreement(pose)
            support = self._support(pose, float(similarity), agreed)
            T_map_camera = transform_from(pose.R_map_level @ self.frames[0].R_level_camera, pose.camera_m)
            candidates.append(Candidate(T_map_camera, pose, float(similarity), float(place_m), agreed, support))
        return sorted(candidates, key=lambda candidate: -candidate.support)

    def agreement(self, pose: Registered) -> Agreement:
        """With the map's depth as drawn at a pose of the reference's level frame, mean over the frames that show anything."""
        return Agreement.mean([
            agreement(self.sights.cloud, points, self._of(frame, pose))
            for frame, points in zip(self.frames, self.seen, strict=True)
            if len(points)
        ])  # fmt: skip

    def brightness(self, pose: Registered) -> float:
        """Agreement with the map's brightness at a pose of the reference's level frame, mean over the frames; 0 where it has none."""
        if self.sights.cloud.brightness is None:
            return 0.0
        if id(pose) not in self._agreed:
            each = [
                agreement_of_brightness(self.sights.cloud.brightness, met, grey, self.photometry)
                for met, grey in zip(met_by(self.sights, self.pictures, pose), self._greys, strict=True)
            ]
            self._agreed[id(pose)] = pose, float(np.mean(each))
        return self._agreed[id(pose)][1]

    def with_brightness(self, candidates: list[Candidate]) -> list[Candidate]:
        """The candidates, the best first, once those in front have been judged by brightness as well.

        Those behind get as much for it as the worst judged: they stay behind, by as much as they were at least.
        """
        judged = [k for k in candidates if k.support >= candidates[0].support - self.weights.behind]
        if self.sights.cloud.brightness is None or len(judged) == 1:
            return candidates
        agreed = [self.brightness(candidate.registered) for candidate in judged]
        agreed += [min(agreed)] * (len(candidates) - len(judged))
        told = [
            replace(k, support=k.support + self.weights.brightness * each)
            for k, each in zip(candidates, agreed, strict=True)
        ]
        return sorted(told, key=lambda candidate: -candidate.support)

    def best_near(self, best: Candidate, near: list[Near]) -> Candidate:
        """The best of some poses near a candidate, the candidate's own the first of them.

        Another takes over what the candidate had against its rivals, since it is in the same place, and what it is better by.
        """
        told = [self.near.still * each.still + self.near.brightness * self.brightness(each.pose) for each in near]
        told[0] += self.near.stay
        chosen = int(np.argmax(told))
        if chosen == 0:
            return best
        (moved,) = self.candidates((near[chosen].pose,))
        gained = moved.support - self._support(best.registered, best.similarity, best.agreement)
        gained += self.weights.brightness * (self.brightness(moved.registered) - self.brightness(best.registered))
        return replace(moved, support=best.support + max(gained, 0.0))

    def _support(self, pose: Registered, similarity: float, agreed: Agreement) -> float:
        """Brightness apart."""
        weights = self.weights
        support = (
            weights.inliers * pose.inliers + weights.similarity * similarity + weights.likelihood * agreed.likelihood
        )
        if self.prior is not None:
            heading = np.arctan2(pose.R_map_level[1, 0], pose.R_map_level[0, 0])
            support += float(self.prior.log_weight(pose.camera_m[None, :2], np.array([heading]))[0])
        return float(support)

    @cached_property
    def _agreed(self) -> dict[int, tuple[Registered, float]]:
        """By identity of the pose, which is held so that no other takes its place."""
        return {}

    @cached_property
    def _greys(self) -> list[NDArray[np.float32]]:
        return [
            grey_of(frame.query.rgb, own.camera, own.covered, self.photometry)
            for frame, own in zip(self.frames, self.blocks, strict=True)
        ]

    def _of(self, frame: Frame, pose: Registered) -> Registered:
        """The pose of a frame's level frame that follows from the reference's."""
        if frame is self.frames[0]:
            return pose
        T = level_from(frame.T_reference_camera, frame.R_level_camera, self.frames[0].R_level_camera)
        R = pose.R_map_level @ T[:3, :3]
        return replace(pose, R_map_level=R, camera_m=pose.camera_m + pose.R_map_level @ T[:3, 3])
