"""The support of a pose: the weighted sum of its scores. ``scorers_of`` lists the scorers."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from service.geometry.rigid import transform_from
from service.maps.reader import MapBundle
from service.registration.local_search import LocalPose
from service.registration.register import Registered
from service.registration.surfel_map import SurfelMap
from service.retrieval.prior import Prior
from service.scoring.candidates import Candidate
from service.scoring.inliers import InlierScorer
from service.scoring.measured import MeasuredFrame
from service.scoring.photometry import BrightnessScorer
from service.scoring.prior import PriorScorer
from service.scoring.rendered_depth import RenderedDepthScorer
from service.scoring.scorer import Scorer
from service.scoring.similarity import SimilarityScorer


@dataclass(frozen=True, slots=True, kw_only=True)
class SupportWeights:
    """Weights of the support of a candidate, in nats per unit of each score.

    Fitted by a conditional logit over the candidates of queries in the validation cities (decisions 0028, 0082 and 0100).

    Attributes:
        inliers: weight of the share of inliers.
        similarity: weight of the descriptor similarity at the pose.
        likelihood: weight of the mean log likelihood of the rendered depth.
        prior: weight of the log weight of the prior, which is in nats already.
        brightness: weight of the agreement with the map's brightness.
        brightness_gap: largest support gap to the best candidate at which brightness is computed, nats. Rendering takes time.
    """

    inliers: float = 20.0
    similarity: float = 68.0
    likelihood: float = 2.4
    prior: float = 1.0
    brightness: float = 80.0
    brightness_gap: float = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalScoreWeights:
    """Weights for the choice among poses about a metre apart, in nats per unit of each score.

    Fitted by a conditional logit over poses around the answers in a validation city. Such poses resemble the same places, so
    descriptor similarity does not tell them apart. Brightness tells more here than between two streets.

    Attributes:
        static_inliers: weight of the share of inliers among points of static objects.
        brightness: weight of the agreement with the map's brightness.
        stay: bonus of the original pose, nats.
    """

    static_inliers: float = 45.0
    brightness: float = 300.0
    stay: float = 1.0


#: A scorer and its weight, nats per unit of the score.
Weighted = tuple[Scorer, float]


def scorers_of(
    bundle: MapBundle,
    cloud: SurfelMap,
    measured: tuple[MeasuredFrame, ...],
    prior: Prior | None,
    weights: SupportWeights,
) -> tuple[Weighted, ...]:
    """Return the scorers that rate every candidate of a query, each with its weight. A new scorer is one more line.

    Brightness is not among them: ``PoseScorer.with_brightness`` adds it for the leading candidates only.

    Args:
        bundle: the map.
        cloud: surfels of the map.
        measured: frames of the query, the reference first.
        prior: prior of the reference pose; None if nothing is known.
        weights: weights of the support.
    """
    return (
        (InlierScorer(), weights.inliers),
        (SimilarityScorer(bundle, measured), weights.similarity),
        (RenderedDepthScorer(cloud, measured), weights.likelihood),
        *(() if prior is None else ((PriorScorer(prior), weights.prior),)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PoseScorer:
    """Sums the weighted scores of the poses of one query.

    Attributes:
        measured: frames of the query, the reference first.
        scorers: scorers that rate every pose, with their weights.
        brightness: scorer that rates the leading poses.
        weights: weights of the support.
        near: weights for the choice among poses about a metre apart.
    """

    measured: tuple[MeasuredFrame, ...]
    scorers: tuple[Weighted, ...]
    brightness: BrightnessScorer
    weights: SupportWeights
    near: LocalScoreWeights

    def candidates(self, found: tuple[Registered, ...]) -> list[Candidate]:
        """Score poses without brightness; return them with the best supported first.

        Args:
            found: registered poses of the reference's level frame.
        """
        scores: dict[str, list[float]] = {}
        for scorer, _ in self.scorers:
            own = scorer.score(found)
            scores |= {name: values.tolist() for name, values in {scorer.name: own.values, **own.details}.items()}
        R_level_camera = self.measured[0].frame.R_level_camera
        candidates = []
        for k, pose in enumerate(found):
            T_map_camera = transform_from(pose.R_map_level @ R_level_camera, pose.camera_m)
            own_scores = {name: values[k] for name, values in scores.items()}
            candidates.append(Candidate(T_map_camera, pose, own_scores, self._support(own_scores)))
        return sorted(candidates, key=lambda candidate: -candidate.support)

    def with_brightness(self, candidates: list[Candidate]) -> list[Candidate]:
        """Add brightness to the support of the leading candidates; return all candidates, the best supported first.

        Only candidates within ``weights.behind`` of the best are compared, because rendering takes time. The others get the
        lowest brightness score of these. So each of them stays at least as far behind the leading ones as before.
        The candidates stay as they are if the map has no brightness or only one candidate leads.

        Args:
            candidates: candidates without brightness, the best supported first.
        """
        leading = [each for each in candidates if each.support >= candidates[0].support - self.weights.brightness_gap]
        if not self.brightness.is_known or len(leading) == 1:
            return candidates
        scores = self.brightness.score(tuple(each.registered for each in leading)).values.tolist()
        rescored = [
            replace(
                each,
                support=each.support + self.weights.brightness * score,
                scores={**each.scores, self.brightness.name: score},
            )
            for each, score in zip(leading, scores, strict=True)
        ]
        least = self.weights.brightness * min(scores)
        rescored += [replace(each, support=each.support + least) for each in candidates[len(leading) :]]
        return sorted(rescored, key=lambda candidate: -candidate.support)

    def select_local_optimum(self, best: Candidate, near: list[LocalPose]) -> Candidate:
        """Choose the best of several poses near a candidate.

        Another pose of the same place inherits the support of the candidate, plus its gain over the candidate if positive.

        Args:
            best: candidate; returned unchanged if its own pose is the best.
            near: poses near the candidate; the first one is the candidate's own pose.
        """
        name = self.brightness.name
        known = [best.scores[name]] if name in best.scores else []
        poses = (best.registered, *(each.pose for each in near[1:]))[len(known) :]
        brightness = [*known, *self.brightness.score(poses).values.tolist()]
        totals = [
            self.near.static_inliers * each.static_inliers + self.near.brightness * score
            for each, score in zip(near, brightness, strict=True)
        ]
        totals[0] += self.near.stay
        chosen = int(np.argmax(totals))
        if chosen == 0:
            return best
        (moved,) = self.candidates((near[chosen].pose,))
        gained = moved.support - self._support(best.scores)
        gained += self.weights.brightness * (brightness[chosen] - brightness[0])
        return replace(
            moved, support=best.support + max(gained, 0.0), scores={**moved.scores, name: brightness[chosen]}
        )

    def _support(self, scores: Mapping[str, float]) -> float:
        """Compute the support of a pose without brightness, nats."""
        support = 0.0
        for scorer, weight in self.scorers:
            support += weight * scores[scorer.name]
        return support
