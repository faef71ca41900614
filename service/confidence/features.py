"""Confidence features of an answer: the inputs of the calibrated confidence, one number each.

``TABLE`` defines each feature: its name, unit, meaning, sign, and how it is computed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.confidence.shape import Shape, shape_of
from service.errors import BundleError
from service.geometry.rigid import heading_of_camera
from service.imaging.view_grid import ViewGrid
from service.maps.calibration import Calibration
from service.retrieval.hypotheses import ClusterSettings, Hypothesis
from service.retrieval.knn import Neighbour
from service.retrieval.retrieve import EncodedFrame, Retrieved
from service.scoring.candidates import Candidate, Refined, distinct_candidates, log_shares, support_gaps

#: A neighbour further than OTHER_PLACE_M from the answer is another place (feature ``similarity_margin``).
#: Of the first VOTERS neighbours, those within VOTE_M of the answer vote for it (feature ``votes``).
OTHER_PLACE_M, VOTE_M, VOTERS = 10.0, 5.0, 20
_NEAREST = 5  # number of the most similar neighbours in ``pose_spread``
_MOST_MARGIN = 12.0  # nats; largest margin, also used if there is no rival
_MOST_PLACE_M = 10.0
_LONE_ADVANTAGE = 0.3  # a typical value of right answers
_LONE_SIMILARITY = 0.5  # similarity of the best neighbour elsewhere if there is none
#: Difference in similarity that counts as much as one nat of the prior (decision 0183).
_SIMILARITY_PER_NAT = ClusterSettings().temperature


@dataclass(frozen=True, eq=False)
class Evidence:
    """The results of the stages that the features are computed from.

    Attributes:
        frames: image pairs, the reference first.
        refined: registered candidates, the best supported first.
        neighbours: distinct places retrieved for the reference, the most similar first.
        hypotheses: clusters of the most similar views of the reference.
        places_xy: x of all places, then y of all places, map frame, metres.
        grid: view grid of the map.
    """

    frames: tuple[EncodedFrame, ...]
    refined: Refined
    neighbours: tuple[Neighbour, ...]
    hypotheses: tuple[Hypothesis, ...]
    places_xy: Float64[NDArray[np.float64], "2 P"]
    grid: ViewGrid

    @property
    def best(self) -> Candidate:
        """The best supported candidate."""
        return self.refined.best

    @cached_property
    def shape(self) -> Shape:
        """Statistics of the reference's view along its optical axis."""
        views = self.frames[0].views
        return shape_of(views.planes[int(np.argmin(np.abs(views.turns_rad))), 0], self.grid)

    @cached_property
    def support_gaps(self) -> Float64[NDArray[np.float64], " C"]:
        """Support gap of each candidate that excludes the others to the best one, nats."""
        return support_gaps(distinct_candidates(self.refined.candidates), len(self.frames))

    @cached_property
    def away_m(self) -> Float64[NDArray[np.float64], " N"]:
        """Horizontal distance of each neighbour from the answer, metres."""
        xy = self.best.T_map_camera[:2, 3]
        return np.array([np.hypot(*(place.position_m[:2] - xy)) for place in self.neighbours])

    def prior_deficit_nats(
        self, xy: Float64[NDArray[np.float64], "n 2"], heading_rad: Float64[NDArray[np.float64], " n"]
    ) -> Float64[NDArray[np.float64], " n"]:
        """Return how much lower the log weight of each pose by the prior is than that of the answer (n,), nats.

        The result is 0 for a pose that the prior allows as much as the answer or more, and without a prior. A pose with a large
        deficit is hardly a rival of the answer (decision 0183).

        Args:
            xy: positions, map frame, metres.
            heading_rad: headings of the optical axis, counter-clockwise from map x, rad.
        """
        prior = self.frames[0].query.prior
        if prior is None:
            return np.zeros(len(xy))
        T = self.best.T_map_camera
        answer = float(prior.log_weight(T[None, :2, 3], np.array([heading_of_camera(T)]))[0])
        return np.maximum(answer - prior.log_weight(xy, heading_rad), 0.0)

    @property
    def inlier_advantage(self) -> float:
        """Inliers of the best candidate minus the median of its rivals; ``_LONE_ADVANTAGE`` without rivals.

        With a prior, the median has the weights of the rivals by the prior. The lower the largest of these weights, the nearer the
        result is to that without rivals.
        """
        others = distinct_candidates(self.refined.candidates)[1:]
        if not others:
            return _LONE_ADVANTAGE
        inliers = np.array([other.registered.inliers for other in others])
        best = self.best.registered.inliers
        if self.frames[0].query.prior is None:
            return best - float(np.median(inliers))
        xy = np.array([other.T_map_camera[:2, 3] for other in others])
        headings = np.array([heading_of_camera(other.T_map_camera) for other in others])
        weights = np.exp(-self.prior_deficit_nats(xy, headings))
        largest = float(weights.max())
        return largest * (best - weighted_median(inliers, weights)) + (1.0 - largest) * _LONE_ADVANTAGE

    @property
    def similarity_margin(self) -> float:
        """Similarity of the best candidate minus that of the most similar neighbour elsewhere, times the root of the frames.

        With a prior, a neighbour's similarity is lower by ``_SIMILARITY_PER_NAT`` for each nat of its deficit, but not below
        ``_LONE_SIMILARITY``.
        """
        xy = np.array([place.position_m[:2] for place in self.neighbours])
        deficit_nats = self.prior_deficit_nats(xy, np.array([place.heading_rad for place in self.neighbours]))
        similarity = np.array([place.similarity for place in self.neighbours])
        lowered = np.maximum(similarity - _SIMILARITY_PER_NAT * deficit_nats, np.minimum(similarity, _LONE_SIMILARITY))
        elsewhere = lowered[self.away_m > OTHER_PLACE_M]
        other = float(elsewhere.max()) if len(elsewhere) else _LONE_SIMILARITY
        return float(np.sqrt(len(self.frames))) * (self.best.scores["similarity"] - other)

    @property
    def votes(self) -> float:
        """Neighbours near the answer, as a share of the places that exist there.

        Without this normalisation a sparse survey would get fewer votes (decision 0033).
        """
        xy = self.best.T_map_camera[:2, 3]
        places = float(np.clip((np.hypot(*(self.places_xy - xy[:, np.newaxis])) < VOTE_M).sum(), 1, VOTERS))
        return float((self.away_m[:VOTERS] < VOTE_M).sum()) / places

    @property
    def entropy(self) -> float:
        """Entropy of the weights of the clusters, nats. With a prior, the weights are multiplied by those of the prior."""
        xy = np.array([hypothesis.position_m[:2] for hypothesis in self.hypotheses])
        weights = np.array([hypothesis.weight for hypothesis in self.hypotheses])
        if self.frames[0].query.prior is not None:
            headings = np.array([hypothesis.heading_rad for hypothesis in self.hypotheses])
            weights = weights * np.exp(-self.prior_deficit_nats(xy, headings))
            weights /= weights.sum()
        return float(-(weights * np.log(np.maximum(weights, 1e-12))).sum())

    @property
    def pose_spread(self) -> float:
        """Log of the sum of 0.1 m and the RMS distance (m) of the first neighbours from their mean."""
        xy = np.array([place.position_m[:2] for place in self.neighbours[:_NEAREST]])
        return float(np.log(np.sqrt(xy.var(axis=0).sum()) + 0.1))


@dataclass(frozen=True, slots=True)
class Feature:
    """One confidence feature.

    Attributes:
        name: name in the calibration file and in answers.
        unit: unit of the value; "1" for a ratio or a share.
        meaning: what it measures.
        sign: effect of a larger value on the probability of a right answer: 1 more, -1 less, 0 not known in advance.
        of: computes the value.
        rivalry: whether it compares competing candidates. The probability that a query is in the map does not use these.
        weighted: whether the confidence uses it.
        ideal: whether it has an ideal value on the side that speaks for a right answer, such as a distance or an error of 0.
    """

    name: str
    unit: str
    meaning: str
    sign: Literal[-1, 0, 1]
    of: Callable[[Evidence], float]
    rivalry: bool = False
    weighted: bool = True
    ideal: bool = False


#: All confidence features, in the order of the calibration file.
#:
#: ``log_share`` has no weight, because it is a separate rule beside the confidence (``service.confidence.decision``, decision
#: 0086). ``similarity`` has none, because it depends more on the kind of street than on the place. Real streets lie four
#: standard deviations below simulated streets (decision 0137). The others without a weight gained nothing on rig families that
#: were left out of the fit (decisions 0149, 0159, 0165 and 0201). They still serve ``reasons``.
TABLE: tuple[Feature, ...] = (
    Feature("margin", "nat", "support gap to the best rival", 1,
            lambda e: float(e.support_gaps[1:].min(initial=_MOST_MARGIN)), rivalry=True, ideal=True),
    Feature("inliers", "1", "share of the points that lie on the map", 1, lambda e: e.best.registered.inliers, weighted=False),
    Feature("mapped_inliers", "1", "the same, relative to the share where the map shows a surface", 1,
            lambda e: e.best.mapped_inliers, weighted=False, ideal=True),
    Feature("similarity", "1", "descriptor similarity to the places around the pose", 1,
            lambda e: e.best.scores["similarity"], weighted=False),
    Feature("similarity_margin", "1", "similarity at the pose minus the best similarity elsewhere", 1,
            lambda e: e.similarity_margin, rivalry=True, ideal=True),
    Feature("likelihood", "nat", "mean log likelihood of the rendered depth", 1, lambda e: e.best.scores["likelihood"],
            weighted=False),
    Feature("through", "1", "share of the mapped points behind the map's surfaces", -1,
            lambda e: e.best.scores["through"] / e.best.mapped_share, ideal=True),
    Feature("front", "1", "share of the mapped points in front of the map's surfaces", -1,
            lambda e: e.best.scores["front"] / e.best.mapped_share, weighted=False, ideal=True),
    Feature("shared_edges", "1", "share of the depth edges of image and map that the other one has too", 1,
            lambda e: e.best.scores["shared_edges"], weighted=False),
    Feature("upper_inliers", "1", "share of the points above vehicles and people that lie on the map", 1,
            lambda e: e.best.scores["upper_inliers"], weighted=False, ideal=True),
    Feature("upper_front", "1", "share of the points above vehicles and people that lie in front of the map's surfaces", -1,
            lambda e: e.refined.confirmation.upper_front, ideal=True),
    Feature("contrast", "1", "how much worse the depth fits if the map's image shifts by a few degrees", 1,
            lambda e: e.refined.confirmation.contrast, ideal=True),
    Feature("along_residual", "1", "how many times worse the depth fits 2 m further along the street", 1,
            lambda e: e.refined.confirmation.along_residual, ideal=True),
    Feature("along_edges", "1", "decrease of the shared depth edges 2 m further along the street", 1,
            lambda e: e.refined.confirmation.along_edges, ideal=True),
    Feature("static_inliers", "1", "share of the rays that meet the map's surface, without what a moved vehicle explains", 1,
            lambda e: e.refined.ray_evidence.static_inliers, ideal=True),
    Feature("upper_through", "1", "share of the rays that pass through the map's surfaces above vehicles and people", -1,
            lambda e: e.refined.ray_evidence.upper_through, ideal=True),
    Feature("occlusion_edges", "1", "share of the depth edges of more than 1 m and 5 % that image and map share", 1,
            lambda e: e.refined.ray_evidence.occlusion_edges, ideal=True),
    Feature("upper_occlusion_edges", "1", "the same for edges of objects above vehicles and people", 1,
            lambda e: e.refined.ray_evidence.upper_occlusion_edges, ideal=True),
    Feature("verified", "log 1", "log odds of the verifier, a network that compares the image with the map", 1,
            lambda e: e.refined.verified, ideal=True),
    Feature("inlier_advantage", "1", "share of inliers minus the median of the rivals", 1,
            lambda e: e.inlier_advantage, rivalry=True, ideal=True),
    Feature("unmapped", "1", "share of the points where the map shows nothing", -1, lambda e: e.best.scores["unmapped"],
            weighted=False),
    Feature("log_sigma", "log m", "larger horizontal standard deviation of the registration", -1,
            lambda e: float(np.log(float(np.sqrt(np.linalg.eigvalsh(e.refined.registration_covariance[:2, :2])[-1]))))),
    Feature("scale", "1 %", "estimated scale error of the depth, unsigned", -1,
            lambda e: abs(float(np.log(e.best.registered.scale))) / 0.01, ideal=True),
    Feature("votes", "1", "neighbours within 5 m of the pose, as a share of the places there", 1,
            lambda e: e.votes, rivalry=True, weighted=False),
    Feature("entropy", "nat", "entropy of the clusters' weights", -1, lambda e: e.entropy, rivalry=True, ideal=True),
    Feature("log_noise", "log 1/m", "standard deviation of the inverse depth of one pixel", -1,
            lambda e: float(np.log(np.median([frame.noise for frame in e.frames])))),
    Feature("points", "3000", "points of a frame", 1, lambda e: e.refined.points / 3000.0 / len(e.frames)),
    Feature("frames", "log 1", "number of frames of the query", 1, lambda e: float(np.log(len(e.frames))), ideal=True),
    Feature("measured", "1", "share of the view grid with a measurement", 1, lambda e: e.frames[0].views.measured_share),
    Feature("place_m", "m", "distance of the places around the pose, at most 10 m", -1,
            lambda e: min(e.best.scores["place_m"], _MOST_PLACE_M), ideal=True),
    Feature("facings", "log 1", "variety of the directions that walls face", 1, lambda e: e.shape.facings),
    Feature("far", "log m", "median range above the horizon", 0, lambda e: e.shape.far),
    Feature("edges", "1", "share of neighbouring cells on different surfaces", 0, lambda e: e.shape.edges),
    Feature("residual", "log 1", "disagreement of the image's patches about the pose, relative to their noise", -1,
            lambda e: float(np.log(e.refined.variance_inflation)), ideal=True),
    Feature("pose_spread", "log m", "distance of the first five neighbours from their mean", -1,
            lambda e: e.pose_spread, rivalry=True, weighted=False),
    Feature("log_share", "log 1", "share of the best candidate in the support of all candidates that exclude each other", 1,
            lambda e: float(log_shares(e.support_gaps)[0]), weighted=False),
)  # fmt: skip

#: Names of the features, in their order.
FEATURES = tuple(feature.name for feature in TABLE)
#: Names of the features that compare competing candidates.
RIVALRY = tuple(feature.name for feature in TABLE if feature.rivalry)
#: Sign of each feature that has an ideal value.
IDEALS: dict[str, int] = {feature.name: feature.sign for feature in TABLE if feature.ideal}
#: Names of the features that the confidence does not use.
UNWEIGHED = tuple(feature.name for feature in TABLE if not feature.weighted)


def weighted_median(values: Float64[NDArray[np.float64], " n"], weights: Float64[NDArray[np.float64], " n"]) -> float:
    """Return the median of values that have weights. Between two values it changes linearly with the weights.

    Equal weights give the usual median.

    Args:
        values: one or more.
        weights: of the values, above 0.
    """
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(0.5 * weights.sum(), share, values[order]))


def evidence_of(
    frames: tuple[EncodedFrame, ...],
    refined: Refined,
    retrieved: Retrieved,
    places_xy: Float64[NDArray[np.float64], "2 P"],
    grid: ViewGrid,
) -> Float64[NDArray[np.float64], " F"]:
    """Compute the confidence features, in the order of ``FEATURES``.

    Args:
        frames: image pairs, the reference first.
        refined: registered candidates, the best supported first.
        retrieved: places and clusters that retrieval found for the reference.
        places_xy: x of all places, then y of all places, map frame, metres.
        grid: view grid of the map.
    """
    evidence = Evidence(frames, refined, retrieved.neighbours, retrieved.hypotheses, places_xy, grid)
    return np.array([feature.of(evidence) for feature in TABLE])


def require_features(calibration: Calibration | None, path: str) -> None:
    """Refuse a calibration of other features than this program computes.

    Args:
        calibration: calibration of a map; None is accepted.
        path: path of the file or the bundle, for the error message.

    Raises:
        BundleError: the names or their order differ.
    """
    if calibration is not None and calibration.names != FEATURES:
        raise BundleError(
            f"{path}: the confidence features differ from those of this release ({', '.join(FEATURES)}); renew the calibration with "
            "`streetfix calibrate --map MAP --calibration stock`, or build the map again",
            field="calibration.json",
        )
