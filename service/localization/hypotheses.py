"""Cluster the most similar views in space and heading: each cluster is one hypothesis of where the query was taken."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy.typing import NDArray

from service.geometry.rigid import Rotation
from service.localization.prior import Prior
from service.localization.search import ViewMatches


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterSettings:
    """How views are gathered into hypotheses. Ours, November 2026.

    Attributes:
        views: how many of the most similar views take part.
        radius_m: how far a member's place may lie from the best view's.
        heading_rad: how far a member's heading may differ from the best view's.
        temperature: a view that is less similar by this much weighs 1/e; near the temperature that training ends at.
    """

    views: int = 24
    radius_m: float = 4.0
    heading_rad: float = float(np.deg2rad(25.0))
    temperature: float = 0.04


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A place where the query may have been taken.

    Attributes:
        weight: share of the similarity weights of all views that took part.
        position_m: similarity-weighted mean of the members' places (the LiDAR's height), map frame.
        heading_rad: similarity-weighted circular mean of the members' headings, map frame.
        normal_map: up, normal to the ground at the best member's place.
        place: the best member's place.
        street: the members' street; -1 where none of them lies in one.
        similarity: of the best member.
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
        """The level frame: x along the heading, z along the ground's normal."""
        x = np.array([np.cos(self.heading_rad), np.sin(self.heading_rad), 0.0])
        x -= self.normal_map * (x @ self.normal_map)
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(self.normal_map, x), self.normal_map], axis=1)


def similarity_weights(
    similarities: Float64[NDArray[np.float64], " n"], temperature: float
) -> Float64[NDArray[np.float64], " n"]:
    """Weights that sum to 1: the softmax that contrastive training shaped the similarities for."""
    weights = np.exp((similarities - similarities.max()) / temperature)
    normalised: Float64[NDArray[np.float64], " n"] = weights / weights.sum()
    return normalised


def cluster(matches: ViewMatches, settings: ClusterSettings) -> tuple[Hypothesis, ...]:
    """Gather views around the best one that is left, until none is left; the heaviest cluster comes first.

    A cluster never spans two streets; views that lie in no street may join either.
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


def believed(hypotheses: tuple[Hypothesis, ...], prior: Prior | None) -> tuple[Hypothesis, ...]:
    """The same clusters, those first that their weight and the prior together speak for."""
    if prior is None:
        return hypotheses
    xy, heading = np.array([each.position_m[:2] for each in hypotheses]), np.array([h.heading_rad for h in hypotheses])
    support = np.log([max(each.weight, 1e-12) for each in hypotheses]) + prior.log_weight(xy, heading)
    return tuple(hypotheses[k] for k in np.argsort(-support, kind="stable"))


def _near(matches: ViewMatches, count: int, settings: ClusterSettings) -> Bool[NDArray[np.bool_], "n n"]:
    """Which of the first ``count`` matches lie near which, in space and heading."""
    at, heading_rad = matches.T_map_place[:count, :2, 3], matches.heading_rad[:count]
    offset_m = at[:, None] - at
    close = np.hypot(offset_m[..., 0], offset_m[..., 1]) <= settings.radius_m
    alike = np.cos(heading_rad[:, None] - heading_rad) >= np.cos(settings.heading_rad)
    near: Bool[NDArray[np.bool_], "n n"] = close & alike
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
