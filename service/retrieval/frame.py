"""One image pair after retrieval and before registration: views, descriptors and the most similar map views."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.geometry.rigid import Rotation, Transform, transform_from
from service.imaging.query_view import QueryViews
from service.retrieval.knn import ViewMatches
from service.retrieval.query import Query


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
    """

    query: Query
    T_reference_camera: Transform
    views: QueryViews
    descriptors: Float32[NDArray[np.float32], "T D"]
    matches: ViewMatches
    noise: float
    independent_noise: float

    @property
    def R_level_camera(self) -> Rotation:
        """Rotation from the camera's optical frame to the level frame."""
        return self.views.R_level_camera

    def T_reference_level(self, reference: "Frame") -> Transform:
        """Compute the pose of this frame's level frame in the level frame of the reference.

        The origin of each level frame is at its camera.

        Args:
            reference: reference frame of the query.
        """
        T_reference_camera, R_level_reference = self.T_reference_camera, reference.R_level_camera
        R = R_level_reference @ T_reference_camera[:3, :3] @ self.R_level_camera.T
        return transform_from(R, R_level_reference @ T_reference_camera[:3, 3])
