"""Score poses by descriptor similarity: how much the query resembles the places around each pose."""

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.maps.map import Map
from service.registration.register import Registered
from service.scoring.measured import MeasuredFrame
from service.scoring.scorer import Scores

#: Number of the nearest places, and of the views of each with the nearest headings. Their mean is less noisy than the best view.
PLACES, VIEWS = 8, 2
#: Standard deviation of the Gaussian weight of a place over its distance. So the density of the survey does not matter (decision 0038).
WIDTH_M = 2.0
_PAIRS = 1_000_000  # pairs of pose and place per batch of distances; limits memory


class SimilarityScorer:
    """Scorer by descriptor similarity.

    Args:
        bundle: the map.
        measured: frames of the query, the reference first.
    """

    name = "similarity"

    def __init__(self, bundle: Map, measured: tuple[MeasuredFrame, ...]) -> None:
        self._bundle, self._measured = bundle, measured

    def score(self, poses: tuple[Registered, ...]) -> Scores:
        """Return the similarity at each pose; the detail ``place_m`` is the distance of the places around it.

        Args:
            poses: one or more registered poses of the reference's level frame.
        """
        T_map_level = np.stack([pose.T_map_level for pose in poses])
        similarity, place_m = similarity_of(self._bundle, self._measured, T_map_level)
        return Scores(similarity, {"place_m": place_m})


def similarity_of(
    bundle: Map, measured: tuple[MeasuredFrame, ...], T_map_level: Float64[NDArray[np.float64], "n 4 4"]
) -> tuple[Float64[NDArray[np.float64], " n"], Float64[NDArray[np.float64], " n"]]:
    """Compute the similarity of all frames of a query to the map at given poses.

    Args:
        bundle: the map.
        measured: frames of the query, the reference first.
        T_map_level: poses of the reference's level frame.

    Returns:
        Per pose the similarity, and the distance of the places around it in metres; both are means over the frames.
    """
    similarities, places_m = [], []
    for each in measured:
        T = each.poses(T_map_level)
        similarity, place_m = similarities_at(
            bundle, each.frame.descriptors, R_map_level=T[:, :3, :3], camera_m=T[:, :3, 3]
        )
        similarities.append(similarity)
        places_m.append(place_m)
    return np.mean(similarities, axis=0), np.mean(places_m, axis=0)


def similarities_at(
    bundle: Map,
    descriptors: Float32[NDArray[np.float32], "T D"],
    *,
    R_map_level: Float64[NDArray[np.float64], "n 3 3"],
    camera_m: Float64[NDArray[np.float64], "n 3"],
) -> tuple[Float64[NDArray[np.float64], " n"], Float64[NDArray[np.float64], " n"]]:
    """Compute the mean similarity of a query to the places around each pose, at the heading of the pose.

    Args:
        bundle: the map.
        descriptors: descriptors of the query views, one row per turn; the most similar turn counts.
        R_map_level: rotation of the query's level frame to the map frame, per pose.
        camera_m: position of the camera of each pose, map frame, m.

    Returns:
        Per pose the weighted mean similarity, and the weighted mean distance of the places in metres. Similarity falls with distance.
    """
    fan = bundle.manifest.headings
    heading = np.arctan2(R_map_level[:, 1, 0], R_map_level[:, 0, 0])
    nearest, away = _nearest(bundle.places_xy, camera_m)
    views = nearest[..., None] * fan + np.arange(fan)
    turned = np.abs((bundle.view_heading_rad[views] - heading[:, None, None] + np.pi) % (2 * np.pi) - np.pi)
    chosen = np.take_along_axis(views, np.argsort(turned, axis=2)[..., : min(VIEWS, fan)], axis=2)
    vectors = bundle.view_index.vectors(chosen.reshape(-1))
    similarities = (vectors @ descriptors.T).max(axis=1).reshape(chosen.shape).max(axis=2)
    least = away.min(axis=1, keepdims=True)
    weight = np.exp((least**2 - away**2) / (2 * WIDTH_M**2))  # the nearest place has weight 1 at any distance
    weight /= weight.sum(axis=1, keepdims=True)
    return (weight * similarities).sum(axis=1), (weight * away).sum(axis=1)


def _nearest(
    places_xy: Float64[NDArray[np.float64], "2 P"], camera_m: Float64[NDArray[np.float64], "n 3"]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Find the ``PLACES`` places nearest to each camera horizontally; return their numbers, unsorted, and distances (m)."""
    count = min(PLACES, places_xy.shape[1])
    nearest, squares = [], []
    at_once = max(1, _PAIRS // places_xy.shape[1])
    for first in range(0, len(camera_m), at_once):
        x, y = camera_m[first : first + at_once, :2].T[..., None]
        square = (places_xy[0] - x) ** 2 + (places_xy[1] - y) ** 2
        nearest.append(np.argpartition(square, count - 1, axis=1)[:, :count])
        squares.append(np.take_along_axis(square, nearest[-1], axis=1))
    return np.concatenate(nearest), np.sqrt(np.concatenate(squares))
