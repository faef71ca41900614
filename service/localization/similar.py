"""How similar a query is to the map where it is said to stand: asked after registration, of the places around the pose."""

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.geometry.rigid import Rotation
from service.maps.reader import MapBundle

#: Places around a pose, and views of each whose headings are nearest: their mean is surer than the one best view's.
PLACES, VIEWS = 8, 2
#: A place counts the less the further it stands from the pose, by a normal curve of this width; how dense the survey is does not matter.
WIDTH_M = 2.0


def similarity_at(
    bundle: MapBundle,
    descriptors: Float32[NDArray[np.float32], "T D"],
    *,
    R_map_level: Rotation,
    camera_m: NDArray[np.float64],
) -> tuple[float, float]:
    """Mean similarity of a query to the places nearest to a pose, each seen at the pose's heading; how far they are, m.

    Args:
        bundle: the map.
        descriptors: of the query's turned views; the most similar turn counts.
        R_map_level: level frame of the query at the pose.
        camera_m: of the pose, map frame.

    Returns:
        The weighted mean of similarity, and that of the places' distances, which the similarity falls with.
    """
    fan = bundle.manifest.headings
    heading = np.arctan2(R_map_level[1, 0], R_map_level[0, 0])
    away = np.hypot(*(bundle.T_map_place[:, :2, 3] - camera_m[:2]).T)
    count = min(PLACES, len(away))
    nearest = np.argpartition(away, count - 1)[:count]
    views = nearest[:, None] * fan + np.arange(fan)
    turned = np.abs((bundle.view_heading_rad[views] - heading + np.pi) % (2 * np.pi) - np.pi)
    chosen = np.take_along_axis(views, np.argsort(turned, axis=1)[:, : min(VIEWS, fan)], axis=1)
    vectors = bundle.view_index.vectors(chosen.reshape(-1))
    similarities = (vectors @ descriptors.T).max(axis=1).reshape(chosen.shape).max(axis=1)
    distance = away[nearest]
    weight = np.exp((distance.min() ** 2 - distance**2) / (2 * WIDTH_M**2))  # of the nearest one 1, however far
    weight /= weight.sum()
    return float(weight @ similarities), float(weight @ distance)
