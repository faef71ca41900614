"""Complete the points of a spinning LiDAR: the time of each point, and a correction of the beams' vertical angle."""

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

#: The beams of KITTI's HDL-64 are recorded this much too low, degrees. kiss-icp applies the same correction.
KITTI_VERTICAL_DEG = 0.205
#: Plausible times of one turn, seconds. Recorded times outside of them do not belong to turns.
SHORTEST_TURN_S, LONGEST_TURN_S = 0.04, 0.25

Points = Float32[NDArray[np.float32], "N 4"]


def times_by_azimuth(points: Points, *, period_s: float) -> Float64[NDArray[np.float64], " N"]:
    """Compute the time of each point relative to the time at which the laser faces forward (x), seconds (N,).

    KITTI's HDL-64 rotates clockwise as seen from above. A file holds one turn: from the rear (minus half a period) over the
    left to the front (0), and over the right back to the rear.

    Args:
        points: of one turn, LiDAR frame, x forward, y left.
        period_s: time of one turn, seconds.
    """
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    return np.asarray(-azimuth / (2 * np.pi) * period_s)


def raised(points: Points, angle_deg: float) -> Points:
    """Rotate every point upwards by an angle, in its own vertical plane. Ranges and azimuths stay.

    Args:
        points: x y z (m, LiDAR frame) and intensity.
        angle_deg: degrees.
    """
    if angle_deg == 0.0:
        return points
    angle = np.deg2rad(angle_deg)
    xyz = points[:, :3].astype(np.float64)
    flat = np.hypot(xyz[:, 0], xyz[:, 1])
    turned_flat = flat * np.cos(angle) - xyz[:, 2] * np.sin(angle)
    scale = np.divide(turned_flat, flat, out=np.ones_like(flat), where=flat > 0)
    moved = points.copy()
    moved[:, 0], moved[:, 1] = xyz[:, 0] * scale, xyz[:, 1] * scale
    moved[:, 2] = np.where(flat > 0, flat * np.sin(angle) + xyz[:, 2] * np.cos(angle), xyz[:, 2])
    return moved


def period_of(stamps_s: Float64[NDArray[np.float64], " N"], *, otherwise_s: float) -> float:
    """Estimate the time of one turn: the median time between consecutive scans, if it is plausible.

    Args:
        stamps_s: times of scans, seconds, in order.
        otherwise_s: result if the stamps give no plausible time, seconds.
    """
    steps = np.diff(stamps_s)
    if not len(steps):
        return otherwise_s
    median_s = float(np.median(steps))
    return median_s if SHORTEST_TURN_S <= median_s <= LONGEST_TURN_S else otherwise_s
