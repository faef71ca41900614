"""How similar a query is to the map where it is said to stand: asked of the places around a pose."""

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.maps.reader import MapBundle

#: Places around a pose, and views of each whose headings are nearest: their mean is surer than the one best view's.
PLACES, VIEWS = 8, 2
#: A place counts the less the further it stands from the pose, by a normal curve of this width; how dense the survey is does not matter.
WIDTH_M = 2.0
_PAIRS = 1_000_000  # of a pose and a place, whose distances are taken at once


def similarities_at(
    bundle: MapBundle,
    descriptors: Float32[NDArray[np.float32], "T D"],
    *,
    R_map_level: Float64[NDArray[np.float64], "n 3 3"],
    camera_m: Float64[NDArray[np.float64], "n 3"],
) -> tuple[Float64[NDArray[np.float64], " n"], Float64[NDArray[np.float64], " n"]]:
    """Mean similarity of a query to the places nearest to each of some poses, seen at the pose's heading; how far they are, m.

    Args:
        bundle: the map.
        descriptors: of the query's turned views; the most similar turn counts.
        R_map_level: level frames of the query at the poses.
        camera_m: of the poses, map frame.

    Returns:
        The weighted mean of similarity, and that of the places' distances, which the similarity falls with.
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
    weight = np.exp((least**2 - away**2) / (2 * WIDTH_M**2))  # of the nearest one 1, however far
    weight /= weight.sum(axis=1, keepdims=True)
    return (weight * similarities).sum(axis=1), (weight * away).sum(axis=1)


def _nearest(
    places_xy: Float64[NDArray[np.float64], "2 P"], camera_m: Float64[NDArray[np.float64], "n 3"]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The ``PLACES`` places nearest to each camera on the ground, in no order, and how far they are, m."""
    count = min(PLACES, places_xy.shape[1])
    nearest, squares = [], []
    at_once = max(1, _PAIRS // places_xy.shape[1])
    for first in range(0, len(camera_m), at_once):
        x, y = camera_m[first : first + at_once, :2].T[..., None]
        square = (places_xy[0] - x) ** 2 + (places_xy[1] - y) ** 2
        nearest.append(np.argpartition(square, count - 1, axis=1)[:, :count])
        squares.append(np.take_along_axis(square, nearest[-1], axis=1))
    return np.concatenate(nearest), np.sqrt(np.concatenate(squares))
