"""The paper's 2.5D image: a whole LiDAR frame seen from above, 224 x 224, height as brightness (II.IV, II.V, section 3).

The paper aligns a cloud "along x-axis" by PCA about z and gets rid of negative z. Its rotation leaves two choices that it does
not speak of, made here: which end of the principal axis is +x (the side towards which the points' third moment lies), and the
square that is drawn (50 m to each side, so that nearly all returns of a street are inside).
"""

import numpy as np
from numpy.typing import NDArray

from service.geometry.rigid import rotation_z
from service.imaging.pca import principal_components

SIZE = 224
REACH_M = 50.0
TOP_M = 12.0  # heights above the lowest ground are drawn from 1 to 255; 0 is "no return"

Points = NDArray[np.floating]
Picture = NDArray[np.uint8]


def aligned_heading(points: Points) -> float:
    """Angle (rad) of the first principal axis of the points' ground plan, its sign by the third moment along it."""
    plan = principal_components(points[:, :2])
    axis = plan.axes[:, 0]
    along = (np.asarray(points[:, :2], np.float64) - plan.mean) @ axis
    if (along**3).sum() < 0:
        axis = -axis
    return float(np.arctan2(axis[1], axis[0]))


def picture_from_above(points: Points, *, aligned: bool) -> Picture:
    """Draw a frame: each cell takes its highest return.

    Args:
        points: (N, 3), metres, sensor axes, z up.
        aligned: turn the first principal axis to x (the paper); else the sensor's own heading stays.

    Returns:
        (224, 224): row 0 is +x, column 0 is +y; 0 where nothing was met.
    """
    picture = np.zeros((SIZE, SIZE), np.uint8)
    if len(points) < 3:
        return picture
    points = np.asarray(points, np.float32)
    lowest = np.percentile(points[:, 2], 1)
    level = np.clip(1 + np.rint((points[:, 2] - lowest) * (254 / TOP_M)), 1, 255).astype(np.uint8)
    xy = points[:, :2]
    if aligned:
        xy = xy @ rotation_z(-aligned_heading(points))[:2, :2].T.astype(np.float32)
    cell = np.floor((REACH_M - xy) * (SIZE / (2 * REACH_M))).astype(np.int64)
    inside = ((cell >= 0) & (cell < SIZE)).all(axis=1)
    np.maximum.at(picture.reshape(-1), cell[inside, 0] * SIZE + cell[inside, 1], level[inside])
    return picture
