"""Score poses by inliers: the share of the query's points that match a map surface within their noise."""

import numpy as np

from service.registration.register import Registered
from service.scoring.scorer import Scores


class InlierScorer:
    """Scorer by the share of inliers, 0 to 1. The solver has counted them."""

    name = "inliers"

    def score(self, poses: tuple[Registered, ...]) -> Scores:
        """Return the share of inliers of each pose.

        Args:
            poses: one or more registered poses of the reference's level frame.
        """
        return Scores(np.array([pose.inliers for pose in poses], np.float64))
