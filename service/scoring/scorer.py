"""Score registered poses. The support of a pose is a weighted sum of the scores; each scorer has a file of its own."""

from dataclasses import dataclass, replace

import numpy as np

from service.geometry.rigid import transform_from
from service.maps.reader import MapBundle
from service.registration.local_search import LocalPose
from service.registration.register import Registered
from service.retrieval.prior import Prior
from service.scoring.candidates import Candidate
from service.scoring.measured import MeasuredFrame
from service.scoring.photometry import BrightnessScorer
from service.scoring.rendered_depth import RenderedDepthScorer
from service.scoring.similarity import similarity_of


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
class PoseScorer:
    """Scorer of one query: sums the weighted scores of any pose.

    Attributes:
        bundle: the map.
        measured: frames of the query, the reference first.
        depth: scorer by rendered depth.
        brightness: scorer by brightness.
        prior: prior of the reference pose; None if nothing is known.
        weights: weights of the support.
        near: weights for the choice among poses about a metre apart.
    """

    bundle: MapBundle
    measured: tuple[MeasuredFrame, ...]
    depth: RenderedDepthScorer
    brightness: BrightnessScorer
    prior: Prior | None
    weights: SupportWeights
    near: LocalScoreWeights

    def candidates(self, found: tuple[Registered, ...]) -> list[Candidate]:
        """Score poses without brightness; return them with the best supported first.

        Args:
            found: registered poses of the reference's level frame.
        """
        T_map_level = np.stack([pose.T_map_level for pose in found])
        similarities, places_m = similarity_of(self.bundle, self.measured, T_map_level)
        R_level_camera = self.measured[0].frame.R_level_camera
        candidates = []
        for pose, similarity, place_m in zip(found, similarities, places_m, strict=True):
            candidate = Candidate(
                transform_from(pose.R_map_level @ R_level_camera, pose.camera_m), pose, float(similarity), float(place_m),
                self.depth.score(pose), support=0.0,
            )  # fmt: skip
            candidates.append(replace(candidate, support=self._support(candidate)))
        return sorted(candidates, key=lambda candidate: -candidate.support)

    def with_brightness(self, candidates: list[Candidate]) -> list[Candidate]:
        """Add brightness to the support of the leading candidates; return all candidates, the best supported first.

        Only candidates within ``weights.behind`` of the best are compared, because rendering takes time. The others get the
        lowest brightness score of these. So each of them stays at least as far behind the leading ones as before.
        The candidates stay as they are if the map has no brightness or only one candidate leads.

        Args:
            candidates: candidates without brightness, the best supported first.
        """
        leading = [each for each in candidates if each.support >= candidates[0].support - self.weights.behind]
        if not self.brightness.is_known or len(leading) == 1:
            return candidates
        scores = [self.brightness.score(each.registered) for each in leading]
        added = [*scores, *[min(scores)] * (len(candidates) - len(leading))]
        told = [
            replace(each, support=each.support + self.weights.brightness * score, brightness=score if rank < len(leading) else None)
            for rank, (each, score) in enumerate(zip(candidates, added, strict=True))
        ]  # fmt: skip
        return sorted(told, key=lambda candidate: -candidate.support)

    def select_local_optimum(self, best: Candidate, near: list[LocalPose]) -> Candidate:
        """Choose the best of several poses near a candidate.

        Another pose of the same place inherits the support of the candidate, plus its gain over the candidate if positive.

        Args:
            best: candidate; returned unchanged if its own pose is the best.
            near: poses near the candidate; the first one is the candidate's own pose.
        """
        own = self.brightness.score(best.registered) if best.brightness is None else best.brightness
        brightness = [own, *(self.brightness.score(each.pose) for each in near[1:])]
        told = [
            self.near.still * each.still + self.near.brightness * score
            for each, score in zip(near, brightness, strict=True)
        ]
        told[0] += self.near.stay
        chosen = int(np.argmax(told))
        if chosen == 0:
            return best
        (moved,) = self.candidates((near[chosen].pose,))
        gained = moved.support - self._support(best)
        gained += self.weights.brightness * (brightness[chosen] - brightness[0])
        return replace(moved, support=best.support + max(gained, 0.0), brightness=brightness[chosen])

    def _support(self, candidate: Candidate) -> float:
        """Compute the support of a pose without brightness: weighted scores plus the log weight of the prior, nats."""
        weights, pose = self.weights, candidate.registered
        support = (
            weights.inliers * pose.inliers + weights.similarity * candidate.similarity
            + weights.likelihood * candidate.agreement.likelihood
        )  # fmt: skip
        if self.prior is not None:
            heading = np.arctan2(pose.R_map_level[1, 0], pose.R_map_level[0, 0])
            support += float(self.prior.log_weight(pose.camera_m[None, :2], np.array([heading]))[0])
        return float(support)
