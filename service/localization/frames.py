"""One image pair after retrieval and before registration: views, descriptors and the most similar map views."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.geometry.rigid import Rotation, Transform
from service.imaging.query_view import QueryViews
from service.localization.query import Query
from service.localization.search import ViewMatches


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """An image pair with the results of the map search.

    Attributes:
        query: image pair, camera and options.
        T_reference_camera: pose of this camera in the camera frame of the reference; identity for the reference itself.
        views: query views, one per turn.
        descriptors: descriptors of the views, one row per turn.
        matches: most similar map views, the best first.
        noise: standard deviation of the inverse depth of one pixel, 1/m.
        independent_noise: the same without the correlated error that adjacent pixels share, 1/m.
        fuse_s: time to compute the views, seconds.
        encode_s: time to compute the descriptors, seconds.
        search_s: time to search the map, seconds.
    """

    query: Query
    T_reference_camera: Transform
    views: QueryViews
    descriptors: Float32[NDArray[np.float32], "T D"]
    matches: ViewMatches
    noise: float
    independent_noise: float
    fuse_s: float = 0.0
    encode_s: float = 0.0
    search_s: float = 0.0

    @property
    def R_level_camera(self) -> Rotation:
        """Rotation from the camera's optical frame to the level frame."""
        return self.views.R_level_camera
