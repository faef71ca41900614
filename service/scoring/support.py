"""The support of a pose: the weighted sum of its scores. ``scorers_of`` lists the scorers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from service.maps.map import Map
from service.registration.local_search import LocalPose
from service.registration.register import Registered
from service.registration.surfel_tiles import Cloud
from service.retrieval.prior import Prior
from service.scoring.candidates import Candidate, is_same_place
from service.scoring.inliers import InlierScorer
from service.scoring.measured import MeasuredFrame
from service.scoring.photometry import BrightnessScorer
from service.scoring.prior import PriorScorer
from service.scoring.ray_evidence import RayScorer, RayWeights
from service.scoring.rendered_depth import RenderedDepthScorer
from service.scoring.scorer import Scorer
from service.scoring.similarity import SimilarityScorer
from service.scoring.structure import StructureScorer, StructureWeights


@dataclass(frozen=True, slots=True, kw_only=True)
class SupportWeights:
    """Weights of the support of a candidate, in nats per unit of each score.

    Fitted by a conditional logit over the candidates of queries, in validation cities (decisions 0028, 0082 and 0100). Training cities
    gave the weights of the structure (decision 0159).

    Attributes:
        inliers: weight of the share of inliers.
        similarity: weight of the descriptor similarity at the pose.
        likelihood: weight of the mean log likelihood of the rendered depth.
        prior: weight of the log weight of the prior, which is in nats already.
        brightness: weight of the agreement with the map's brightness.
        brightness_gap: largest support gap to the best candidate at which brightness is computed, nats. Rendering takes time.
        structure: weights of the depth structure.
        structure_gap: the same gap for the depth structure.
        rays: weights of the comparison along the rays.
        rays_gap: the same gap for this comparison. It comes last and takes most time.
        rays_most: largest number of places that are compared along the rays.
    """

    inliers: float = 20.0
    similarity: float = 68.0
    likelihood: float = 2.4
    prior: float = 1.0
    brightness: float = 80.0
    brightness_gap: float = 4.0
    structure: StructureWeights = field(default_factory=StructureWeights)
    structure_gap: float = 8.0
    rays: RayWeights = field(default_factory=RayWeights)
    rays_gap: float = 8.0
    rays_most: int = 4

    def __post_init__(self) -> None:
        """Check that every candidate with a brightness or rays has a structure, so that the best one always has it.

        Raises:
            ValueError: ``brightness_gap`` or ``rays_gap`` exceeds ``structure_gap``.
        """
        for name in ("brightness_gap", "rays_gap"):
            if getattr(self, name) > self.structure_gap:
                raise ValueError(
                    f"{name}: {getattr(self, name):g} must be at most structure_gap ({self.structure_gap:g})"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalScoreWeights:
    """Weights for the choice among poses about a metre apart, in nats per unit of each score.

    Fitted by a conditional logit over poses around the answers in a validation city. Such poses resemble the same places, so
    descriptor similarity does not separate them. Brightness separates them better than it separates two streets.

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
    bundle: Map,
    cloud: Cloud,
    measured: tuple[MeasuredFrame, ...],
    prior: Prior | None,
    weights: SupportWeights,
) -> tuple[Weighted, ...]:
    """Return the scorers that rate every candidate of a query, each with its weight. A new scorer is one more line.

    Depth structure, brightness and rays are not among them: ``PoseScorer.with_details`` adds them for the leading candidates only.

    Args:
        bundle: the map.
        cloud: cloud of the map.
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
        structure: scorer that rates the leading poses.
        brightness: another scorer that rates the leading poses.
        rays: the last scorer that rates the leading poses.
        weights: weights of the support.
        near: weights for the choice among poses about a metre apart.
    """

    measured: tuple[MeasuredFrame, ...]
    scorers: tuple[Weighted, ...]
    structure: StructureScorer
    brightness: BrightnessScorer
    rays: RayScorer
    weights: SupportWeights
    near: LocalScoreWeights

    def candidates(self, found: tuple[Registered, ...]) -> list[Candidate]:
        """Score poses without depth structure, brightness and rays; return them with the best supported first.

        Args:
            found: registered poses of the reference's level frame.
        """
        scores: dict[str, list[float]] = {}
        for scorer, _ in self.scorers:
            own = scorer.score(found)
            scores |= {name: values.tolist() for name, values in {scorer.name: own.values, **own.details}.items()}
        candidates = []
        for k, pose in enumerate(found):
            T_map_camera = self.measured[0].frame.pose_of_camera(pose.T_map_level)
            own_scores = {name: values[k] for name, values in scores.items()}
            candidates.append(Candidate(T_map_camera, pose, own_scores, self._support(own_scores)))
        return sorted(candidates, key=lambda candidate: -candidate.support)

    def with_details(self, candidates: list[Candidate]) -> list[Candidate]:
        """Add depth structure, brightness and rays to the support; return all candidates, the best supported first.

        All three render the map, which takes time. So only candidates whose support is near that of the best are compared. The best one
        always has its structure, for the confidence. Brightness is left out if the map has none. Brightness and rays are left out if only
        one candidate leads.

        Args:
            candidates: candidates as ``candidates`` returns them, the best supported first.
        """
        weights = self.weights
        candidates = _rescored(candidates, self.structure, 1.0, weights.structure_gap)
        if self.brightness.is_known and len(_leading(candidates, weights.brightness_gap)) > 1:
            candidates = _rescored(candidates, self.brightness, weights.brightness, weights.brightness_gap)
        return self._with_rays(candidates)

    def _with_rays(self, candidates: list[Candidate]) -> list[Candidate]:
        """Add the comparison along the rays to the support, if the leading candidates are at several places.

        Only the best supported candidate of each place is compared. The others there get its score, because the adjustment moves them to
        the same pose. Candidates elsewhere get the lowest score in their support.
        """
        leading = _leading(candidates, self.weights.rays_gap)
        places = list[Candidate]()
        for each in leading:
            if not any(is_same_place(each, other) for other in places):
                places.append(each)
        if len(places) == 1:
            return candidates
        compared = places[: self.weights.rays_most]
        values = self.rays.score(tuple(each.registered for each in compared)).values.tolist()
        rescored = [replace(each, support=each.support + min(values)) for each in candidates]
        for k, each in enumerate(leading):
            for other, value in zip(compared, values, strict=True):
                if is_same_place(each, other):
                    scores = {**each.scores, self.rays.name: value}
                    rescored[k] = replace(each, support=each.support + value, scores=scores)
                    break
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
        (moved,) = _rescored(self.candidates((near[chosen].pose,)), self.structure, 1.0, 0.0)
        gained = moved.support - self._support(best.scores) - best.scores[self.structure.name]
        gained += self.weights.brightness * (brightness[chosen] - brightness[0])
        return replace(
            moved, support=best.support + max(gained, 0.0), scores={**moved.scores, name: brightness[chosen]}
        )

    def _support(self, scores: Mapping[str, float]) -> float:
        """Compute the support of a pose without depth structure and brightness, nats."""
        support = 0.0
        for scorer, weight in self.scorers:
            support += weight * scores[scorer.name]
        return support


def _leading(candidates: list[Candidate], gap: float) -> list[Candidate]:
    """Return the candidates whose support is within ``gap`` (nats) of the best; the list has the best supported first."""
    return [each for each in candidates if each.support >= candidates[0].support - gap]


def _rescored(candidates: list[Candidate], scorer: Scorer, weight: float, gap: float) -> list[Candidate]:
    """Add a score to the leading candidates; return all, the best supported first.

    The others get the lowest score of the leading ones. So each of them stays at least as far behind these as before.
    """
    leading = _leading(candidates, gap)
    found = scorer.score(tuple(each.registered for each in leading))
    scores = {scorer.name: found.values.tolist(), **{name: values.tolist() for name, values in found.details.items()}}
    rescored = [
        replace(
            each,
            support=each.support + weight * scores[scorer.name][k],
            scores={**each.scores, **{name: values[k] for name, values in scores.items()}},
        )
        for k, each in enumerate(leading)
    ]
    least = weight * min(scores[scorer.name])
    rescored += [replace(each, support=each.support + least) for each in candidates[len(leading) :]]
    return sorted(rescored, key=lambda candidate: -candidate.support)
