"""Measure how far the rows of a rectified stereo pair are apart, and move the right image onto the rows of the left one.

A matcher compares pixels of one row. Published rectifications leave errors of a few tenths of a pixel (Cvisic, Markovic and Petrovic,
RA-L 2021, for KITTI). The images themselves show them: matched features have different rows. The disparity offset of the same error is
not visible in the images, so it remains (decision 0176).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy.typing import NDArray
from scipy.optimize import least_squares

from service.geometry.camera import PinholeCamera

Rgb = UInt8[NDArray[np.uint8], "H W 3"]
#: Corresponding pixels of a pair: u and v in the left image, then u and v in the right image.
Matches = Float64[NDArray[np.float64], "N 4"]

#: Number of pairs, evenly spaced along the drive, that the alignment is measured on.
PAIRS = 12
#: Fewest matched features for an alignment.
FEWEST_MATCHES = 200
#: Features per image. A match counts if the second best one is worse by Lowe's ratio (IJCV 2004), and if it is plausible.
_FEATURES, _RATIO = 3000, 0.7
_MOST_ROWS_PX, _MOST_DISPARITY_PX = 3.0, 128.0
#: Scale of the robust loss, pixels: the usual error of a matched feature.
_LOSS_PX = 0.15


@dataclass(frozen=True, slots=True)
class RowAlignment:
    """Small rotation of the right camera that explains the rows of its matched features.

    Attributes:
        pitch_rad: rotation about its horizontal axis, radians; positive moves its features down.
        roll_rad: rotation about its optical axis, radians; positive moves features on the right side down.
        matches: number of features that it was measured on.
    """

    pitch_rad: float
    roll_rad: float
    matches: int

    def rows_px(self, u: NDArray[np.float64], v: NDArray[np.float64], camera: PinholeCamera) -> NDArray[np.float64]:
        """Return how many rows lower the right image shows what the left image shows, pixels (n,).

        Args:
            u: columns in the right image, pixels (n,).
            v: rows, pixels (n,).
            camera: intrinsics of both cameras.
        """
        rows: NDArray[np.float64] = _directions(u, v, camera) @ np.array([self.pitch_rad, self.roll_rad])
        return rows

    def aligned(self, right: Rgb, camera: PinholeCamera) -> Rgb:
        """Return the right image with its rows moved onto those of the left image.

        Args:
            right: sRGB.
            camera: intrinsics of both cameras.
        """
        height, width = right.shape[:2]
        v, u = np.mgrid[:height, :width].astype(np.float64)
        rows = self.rows_px(u.ravel(), v.ravel(), camera).reshape(height, width)
        moved: Rgb = cv2.remap(
            right,
            u.astype(np.float32),
            (v + rows).astype(np.float32),
            cv2.INTER_LANCZOS4,
            borderMode=cv2.BORDER_REPLICATE,
        ).astype(np.uint8)
        return moved


def row_alignment(pairs: Iterable[tuple[Rgb, Rgb]], camera: PinholeCamera) -> RowAlignment | None:
    """Measure the rows of a rig on some of its pairs.

    Args:
        pairs: left and right images, sRGB.
        camera: intrinsics of both cameras.

    Returns:
        The alignment; None with fewer than ``FEWEST_MATCHES`` matched features.
    """
    matches = np.concatenate([np.empty((0, 4)), *(matched_features(left, right) for left, right in pairs)])
    if len(matches) < FEWEST_MATCHES:
        return None
    directions = _directions(matches[:, 2], matches[:, 1], camera)
    lower_px = matches[:, 3] - matches[:, 1]

    def difference(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
        rows: NDArray[np.float64] = directions @ rotation - lower_px
        return rows

    found = least_squares(difference, np.zeros(2), loss="cauchy", f_scale=_LOSS_PX, x_scale="jac").x
    return RowAlignment(float(found[0]), float(found[1]), len(matches))


def matched_features(left: Rgb, right: Rgb) -> Matches:
    """Match SIFT features (Lowe, IJCV 2004) of a rectified pair; empty if an image has too few.

    Args:
        left: sRGB.
        right: sRGB, of the camera on the right.
    """
    sift = cv2.SIFT.create(_FEATURES)
    (of_left, left_descriptors), (of_right, right_descriptors) = (
        sift.detectAndCompute(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), None) for each in (left, right)
    )
    if len(of_left) < 2 or len(of_right) < 2:
        return np.empty((0, 4))
    best_two = cv2.BFMatcher(cv2.NORM_L2).knnMatch(left_descriptors, right_descriptors, 2)
    found = [
        (*of_left[best.queryIdx].pt, *of_right[best.trainIdx].pt)
        for best, second in best_two
        if best.distance < _RATIO * second.distance
    ]
    matches = np.array(found, float).reshape(-1, 4)
    disparity, lower = matches[:, 0] - matches[:, 2], matches[:, 3] - matches[:, 1]
    plausible = (disparity > 0) & (disparity < _MOST_DISPARITY_PX) & (np.abs(lower) < _MOST_ROWS_PX)
    kept: Matches = matches[plausible]
    return kept


def _directions(
    u: NDArray[np.float64], v: NDArray[np.float64], camera: PinholeCamera
) -> Float64[NDArray[np.float64], "N 2"]:
    """Return the derivatives of a row by pitch and by roll, pixels per radian: f (1 + y^2) and f x of the normalised image."""
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return camera.fy * np.stack([1 + y**2, x], axis=1)
