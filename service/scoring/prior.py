"""Score poses by the prior that the robot sent: the log weight of each pose."""

import numpy as np

from service.registration.register import Registered
from service.retrieval.prior import Prior
from service.scoring.scorer import Scores


class PriorScorer:
    """Scorer by a prior: 0 nats at the prior, near ``MOST_DOUBT`` far from it.

    Args:
        prior: prior of the reference pose.
    """

    name = "prior"

    def __init__(self, prior: Prior) -> None:
        self._prior = prior

    def score(self, poses: tuple[Registered, ...]) -> Scores:
        """Return the log weight of each pose, nats.

        Args:
            poses: one or more registered poses of the reference's level frame.
        """
        xy = np.array([pose.camera_m[:2] for pose in poses])
        heading_rad = np.array([np.arctan2(pose.R_map_level[1, 0], pose.R_map_level[0, 0]) for pose in poses])
        return Scores(self._prior.log_weight(xy, heading_rad))
