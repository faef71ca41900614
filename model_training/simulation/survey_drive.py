"""How the survey was recorded: pose error, speed during a revolution of the LiDAR, and a vehicle that drives ahead."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Duration of one revolution of the LiDAR, seconds.
TURN_S = 0.1


@dataclass(frozen=True, slots=True)
class SurveyModel:
    """Motion and pose error of one survey.

    Attributes:
        position_m: standard deviation of the smooth position error per axis, metres.
        angle_deg: standard deviation of the smooth error of each angle, degrees.
        speed_m_s: speed of the vehicle during a revolution of the LiDAR, metres per second; 0: it stands still for each scan.
        deskewed: whether the scans are corrected for the motion, as with odometry.
        followed: share of the way on which another vehicle drives ahead.
    """

    position_m: float = 0.03
    angle_deg: float = 0.05
    speed_m_s: float = 0.0
    deskewed: bool = True
    followed: float = 0.0


def moved_m(rays: NDArray[np.float32], speed_m_s: float) -> NDArray[np.float32]:
    """Return the LiDAR's displacement (n, 3) at each ray, metres, in its own frame in the middle of the revolution.

    The LiDAR rotates from azimuth -pi to pi.

    Args:
        rays: directions (n, 3), LiDAR frame.
        speed_m_s: forward speed (x), metres per second.
    """
    when_s = np.arctan2(rays[:, 1], rays[:, 0]) / (2 * np.pi) * TURN_S
    offsets = np.zeros_like(rays)
    offsets[:, 0] = speed_m_s * when_s
    return offsets
