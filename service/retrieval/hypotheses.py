"""Cluster the most similar views in space and heading: each cluster is one hypothesis of where the query was taken."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy.typing import NDArray

from service.geometry.rigid import Rotation
from service.retrieval.knn import ViewMatches, similarity_weights
from service.retrieval.prior import Prior


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterSettings:
    """Settings of the clustering. Our own choice, November 2026.

    Attributes:
        views: number of the most similar views to cluster.
        radius_m: largest horizontal distance of a member's place from the place of the best view.
        heading_rad: largest difference of a member's heading from the heading of the best view.
        temperature: softmax temperature of the similarity weights. A view that is less similar by this much has 1/e of
            the weight. The value is near the temperature at the end of training.
    """

    views: int = 24
    radius_m: float = 4.0
    heading_rad: float = float(np.deg2rad(25.0))
    temperature: float = 0.04


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A cluster of similar views: a place where the query may have been taken.

    Attributes:
        weight: the cluster's share of the similarity weights of all clustered views, 0 to 1.
        position_m: similarity-weighted mean of the members' places, map frame, at LiDAR height.
        heading_rad: similarity-weighted circular mean of the members' headings, map frame.
        normal_map: ground normal (up) at the place of the best member, map frame.
        place: number of the best member's place.
        street: number of the members' street; -1 if no member lies in a street.
        similarity: cosine similarity of the best member.
        members: number of views.
    """

    weight: float
    position_m: Float64[NDArray[np.float64], "3"]
    heading_rad: float
    normal_map: Float64[NDArray[np.float64], "3"]
    place: int
    street: int
    similarity: float
    members: int

    @property
    def R_map_level(self) -> Rotation:
        """Rotation from the level frame to the map frame: x along the heading, z along the ground normal."""
        x = np.array([np.cos(self.heading_rad), np.sin(self.heading_rad), 0.0])
        x -= self.normal_map * (x @ self.normal_map)
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(self.normal_map, x), self.normal_map], axis=1)


def cluster(matches: ViewMatches, settings: ClusterSettings) -> tuple[Hypothesis, ...]:
    """Cluster the most similar views; return the heaviest cluster first.

    The best remaining view starts a cluster with all remaining views near it, until no view remains.
    A cluster never spans two streets. A view outside all streets may join a cluster of any street.

    Args:
        matches: most similar map views, the best first.
        settings: number of views and size of a cluster.
    """
    count = min(settings.views, len(matches))
    weights = similarity_weights(matches.similarity[:count], settings.temperature)
    near = _near(matches, count, settings)
    streets, left = matches.street[:count], np.ones(count, np.bool_)
    found: list[Hypothesis] = []
    while left.any():
        members = near[left.argmax()] & left
        named = streets[members & (streets >= 0)]
        if len(named):
            members &= (streets == named[0]) | (streets < 0)
        left &= ~members
        found.append(_hypothesis(np.flatnonzero(members), matches, weights))
    return tuple(sorted(found, key=lambda hypothesis: -hypothesis.weight))


def rerank_with_prior(hypotheses: tuple[Hypothesis, ...], prior: Prior | None) -> tuple[Hypothesis, ...]:
    """Sort clusters by the log of their weight plus the log weight of the prior, the largest sum first.

    Args:
        hypotheses: clusters; the order stays if there is no prior.
        prior: prior of the camera pose; None if nothing is known.
    """
    if prior is None:
        return hypotheses
    xy, heading = np.array([each.position_m[:2] for each in hypotheses]), np.array([h.heading_rad for h in hypotheses])
    support = np.log([max(each.weight, 1e-12) for each in hypotheses]) + prior.log_weight(xy, heading)
    return tuple(hypotheses[k] for k in np.argsort(-support, kind="stable"))


def _near(matches: ViewMatches, count: int, settings: ClusterSettings) -> Bool[NDArray[np.bool_], "n n"]:
    """Return for every pair of the first ``count`` matches whether they are near in position and in heading."""
    at, heading_rad = matches.T_map_place[:count, :2, 3], matches.heading_rad[:count]
    offset_m = at[:, None] - at
    close = np.hypot(offset_m[..., 0], offset_m[..., 1]) <= settings.radius_m
    same_heading = np.cos(heading_rad[:, None] - heading_rad) >= np.cos(settings.heading_rad)
    near: Bool[NDArray[np.bool_], "n n"] = close & same_heading
    return near


def _hypothesis(
    rows: NDArray[np.intp], matches: ViewMatches, weights: Float64[NDArray[np.float64], " n"]
) -> Hypothesis:
    total = float(weights[rows].sum())
    share = weights[rows] / total
    headings = matches.heading_rad[rows]
    best, streets = int(rows[0]), matches.street[rows]
    return Hypothesis(
        weight=total,
        position_m=share @ matches.T_map_place[rows, :3, 3],
        heading_rad=float(np.arctan2(share @ np.sin(headings), share @ np.cos(headings))),
        normal_map=matches.T_map_place[best, :3, 2].copy(),
        place=int(matches.place[best]),
        street=int(streets.max()),
        similarity=float(matches.similarity[best]),
        members=len(rows),
    )
