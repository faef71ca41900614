"""What a spinning LiDAR's points do not say themselves: when each was measured, and a known error of the beams' angles."""

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

#: KITTI's HDL-64 tells everything so much too low; kiss-icp corrects it by as much.
KITTI_VERTICAL_DEG = 0.205
#: A turn takes about so long; recorded times that say otherwise are those of something else.
SHORTEST_TURN_S, LONGEST_TURN_S = 0.04, 0.25

Points = Float32[NDArray[np.float32], "N 4"]


def times_by_azimuth(points: Points, *, period_s: float) -> Float64[NDArray[np.float64], " N"]:
    """When each point was measured, seconds, against the moment when the laser faced ahead (x).

    KITTI's HDL-64 turns clockwise as seen from above, and a file holds one turn from the rear (-half a period) over the left to the
    front (0) and over the right back to the rear.

    Args:
        points: of one turn, LiDAR frame, x ahead, y left.
        period_s: of one turn.
    """
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    return np.asarray(-azimuth / (2 * np.pi) * period_s)


def raised(points: Points, angle_deg: float) -> Points:
    """The points turned up by an angle about the horizontal axis across each one's own direction; ranges and azimuths stay."""
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
    """Time of one turn from the stamps of consecutive scans: their median difference, if that is a turn's.

    Args:
        stamps_s: of scans, in order.
        otherwise_s: where they do not tell.
    """
    steps = np.diff(stamps_s)
    if not len(steps):
        return otherwise_s
    median_s = float(np.median(steps))
    return median_s if SHORTEST_TURN_S <= median_s <= LONGEST_TURN_S else otherwise_s
