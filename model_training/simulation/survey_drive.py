"""How the survey's vehicle drove: how well its poses are known, how fast it was while the LiDAR turned, and who drove ahead of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: One turn of the LiDAR, seconds.
TURN_S = 0.1


@dataclass(frozen=True, slots=True)
class SurveyModel:
    """Of one survey.

    Attributes:
        position_m: smooth error of the poses, one sigma an axis.
        angle_deg: and of their angles.
        speed_m_s: at which the vehicle drove while the LiDAR turned; 0: it stood still for each scan.
        deskewed: the motion was taken out of the scans, as the odometry tells it.
        followed: share of the way on which another vehicle drives ahead.
    """

    position_m: float = 0.03
    angle_deg: float = 0.05
    speed_m_s: float = 0.0
    deskewed: bool = True
    followed: float = 0.0


def moved_m(rays: NDArray[np.float32], speed_m_s: float) -> NDArray[np.float32]:
    """Where the LiDAR was (n, 3), metres, in its own frame of mid-turn, when it sent each ray; it turns from -pi to pi."""
    when_s = np.arctan2(rays[:, 1], rays[:, 0]) / (2 * np.pi) * TURN_S
    offsets = np.zeros_like(rays)
    offsets[:, 0] = speed_m_s * when_s
    return offsets
