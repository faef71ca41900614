"""What one picture pair says before the map's cloud is asked: its views, their descriptors, the most similar places."""

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
    """A picture pair that was looked up.

    Attributes:
        query: as it was asked.
        T_reference_camera: where its camera stood against the frame whose pose is wanted; identity for that one.
        views: of the view grid.
        descriptors: of the views, a row a turn.
        matches: the most similar views of the map, the best first.
        noise: standard deviation of one pixel's inverse depth, 1/m;
        independent_noise: and that of the part which near pixels do not share.
        fuse_s: seconds that its views took;
        encode_s: their descriptors;
        search_s: and their neighbours.
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
        """From the optical to the frame's level frame."""
        return self.views.R_level_camera
