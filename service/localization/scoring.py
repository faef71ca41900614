"""Score registered poses: inliers, descriptor similarity, likelihood of the rendered depth, and brightness."""

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
from service.registration.local_search import LocalPose
from service.registration.photometry import PhotometrySettings, agreement_of_brightness, grey_of
from service.registration.points import DepthBlocks
from service.registration.rays import RayPicture, met_by
from service.registration.register import Registered
from service.registration.rendered import Agreement, ProjectedPoints, agreement
from service.registration.visibility import SurfelRaycaster


@dataclass(frozen=True, slots=True, kw_only=True)
class SupportWeights:
    """Weights of the support of a candidate, in nats per unit of each score.

    Fitted by a conditional logit over the candidates of queries in the validation cities (decisions 0028, 0082 and 0100).

    Attributes:
        inliers: weight of the share of inliers.
        similarity: weight of the descriptor similarity at the pose.
        likelihood: weight of the mean log likelihood of the rendered depth.
        brightness: weight of the agreement with the map's brightness.
        behind: support gap to the best candidate, in nats, up to which brightness is computed, because rendering takes time.
    """

    inliers: float = 20.0
    similarity: float = 68.0
    likelihood: float = 2.4
    brightness: float = 80.0
    behind: float = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalScoreWeights:
    """Weights for the choice among poses about a metre apart, in nats per unit of each score.

    Fitted by a conditional logit over poses around the answers in a validation city. Such poses resemble the same places, so
    descriptor similarity does not tell them apart. Brightness tells more here than between two streets.

    Attributes:
        still: weight of the share of inliers among points of static objects.
        brightness: weight of the agreement with the map's brightness.
        stay: bonus of the original pose, nats.
    """

    still: float = 45.0
    brightness: float = 300.0
    stay: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A registered pose and its scores.

    Attributes:
        T_map_camera: pose of the reference camera.
        registered: result of the solver. For the best candidate the ray adjustment then moves the pose by centimetres. Its
            scores below come from before this adjustment.
        similarity: descriptor similarity to the places around the pose, mean over the frames.
        place_m: distance of these places from the pose in metres, mean over the frames.
        agreement: agreement with the depth rendered from the map at the pose, mean over the frames.
        support: weighted sum of the scores, in nats; only differences between candidates have a meaning.
        covariance: of ``T_map_camera``, if the candidate is right: translation (m), then rotation (rad), in map axes, about the
            camera. None if not computed.
    """

    T_map_camera: Transform
    registered: Registered
    similarity: float
    place_m: float
    agreement: Agreement
    support: float
    covariance: Float64[NDArray[np.float64], "6 6"] | None = None


@dataclass(frozen=True, eq=False)
class PoseScorer:
    """Scorer of one query: compares its frames with the map at any pose.

    Attributes:
        bundle: the map.
        sights: ray casting into the map cloud.
        frames: image pairs, the reference first.
        seen: points of each frame, as pixels of the rendered depth image.
        blocks: depth blocks of each frame.
        pictures: inverse depth image of each frame.
        prior: prior of the reference pose; None if nothing is known.
        weights: weights of the support.
        near: weights for the choice among poses about a metre apart.
        photometry: settings of the brightness comparison.
    """

    bundle: MapBundle
    sights: SurfelRaycaster
    frames: tuple[Frame, ...]
    seen: list[ProjectedPoints]
    blocks: list[DepthBlocks]
    pictures: list[RayPicture]
    prior: Prior | None
    weights: SupportWeights
    near: LocalScoreWeights
    photometry: PhotometrySettings

    def candidates(self, found: tuple[Registered, ...]) -> list[Candidate]:
        """Score poses without brightness; return them with the best supported first.

        Args:
            found: registered poses of the reference's level frame.
        """
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
        """Compare the query with the depth rendered from the map at a pose; return the mean over all frames that have points.

        Args:
            pose: registered pose of the reference's level frame.
        """
        return Agreement.mean([
            agreement(self.sights.cloud, points, self._of(frame, pose))
            for frame, points in zip(self.frames, self.seen, strict=True)
            if len(points)
        ])  # fmt: skip

    def brightness(self, pose: Registered) -> float:
        """Compare the images with the map's brightness at a pose; return the mean squared correlation over all frames.

        Args:
            pose: registered pose of the reference's level frame.

        Returns:
            0 to 1; 0 if the map has no brightness.
        """
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
        """Add brightness to the support of the leading candidates; return all candidates, the best supported first.

        Only candidates within ``weights.behind`` of the best are compared. The others get the lowest brightness score of these.
        So each of them stays at least as far behind the leading ones as before.
        The candidates stay as they are if the map has no brightness or only one candidate leads.

        Args:
            candidates: candidates without brightness, the best supported first.
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

    def select_local_optimum(self, best: Candidate, near: list[LocalPose]) -> Candidate:
        """Choose the best of several poses near a candidate.

        Another pose of the same place inherits the support of the candidate, plus its gain over the candidate if positive.

        Args:
            best: candidate; returned unchanged if its own pose is the best.
            near: poses near the candidate; the first one is the candidate's own pose.
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
        """Compute the support of a pose without brightness: weighted scores plus the log weight of the prior, nats."""
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
        """Return the cache of brightness scores, keyed by id(pose). It holds the pose, so that Python does not reuse the id."""
        return {}

    @cached_property
    def _greys(self) -> list[NDArray[np.float32]]:
        return [
            grey_of(frame.query.rgb, own.camera, own.covered, self.photometry)
            for frame, own in zip(self.frames, self.blocks, strict=True)
        ]

    def _of(self, frame: Frame, pose: Registered) -> Registered:
        """Return the pose of a frame's level frame, given the pose of the reference's level frame."""
        if frame is self.frames[0]:
            return pose
        T = level_from(frame.T_reference_camera, frame.R_level_camera, self.frames[0].R_level_camera)
        R = pose.R_map_level @ T[:3, :3]
        return replace(pose, R_map_level=R, camera_m=pose.camera_m + pose.R_map_level @ T[:3, 3])
