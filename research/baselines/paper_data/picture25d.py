"""The paper's 2.5D image: a whole LiDAR frame from above, 224 x 224, height as brightness (II.IV, II.V, section 3).

The paper aligns a cloud "along x-axis" by PCA about z and removes negative z. It leaves two choices open. We take as +x
the end of the principal axis towards the third moment of the points. We render a square of 50 m to each side, which
contains nearly all returns of a street.
"""

import numpy as np
from numpy.typing import NDArray

from service.geometry.rigid import rotation_z
from service.imaging.pca import principal_components, project

SIZE = 224
REACH_M = 50.0
#: Height above the lowest ground that maps to 255, metres. Heights use 1 to 255, and 0 means no return.
TOP_M = 12.0

Points = NDArray[np.floating]
Picture = NDArray[np.uint8]


def aligned_heading(points: Points) -> float:
    """Return the angle (rad) of the first principal axis in the ground plane; the third moment gives its sign.

    Args:
        points: points (N, 3), metres.
    """
    plan = principal_components(points[:, :2])
    axis = plan.axes[:, 0]
    along = project(points[:, :2], plan)[:, 0]
    if (along**3).sum() < 0:
        axis = -axis
    return float(np.arctan2(axis[1], axis[0]))


def picture_from_above(points: Points, *, aligned: bool) -> Picture:
    """Render a frame from above; each cell takes its highest return.

    Args:
        points: points (N, 3), metres, sensor axes, z up.
        aligned: True rotates the first principal axis to x, as in the paper; False keeps the sensor's heading.

    Returns:
        Image (224, 224): row 0 is +x, column 0 is +y; 0 for no return.
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
