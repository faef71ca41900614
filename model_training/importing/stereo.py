"""Depth from a rectified stereo pair by semi-global matching (Hirschmüller 2008, OpenCV's StereoSGBM)."""

from dataclasses import asdict, dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

Rgb = UInt8[NDArray[np.uint8], "H W 3"]

#: StereoSGBM counts disparity in sixteenths of a pixel.
_STEPS_PER_PIXEL = 16


@dataclass(frozen=True, slots=True)
class StereoMatching:
    """Settings of StereoSGBM (MODE_HH): those of the recordings' figures; penalties as OpenCV's manual advises.

    Attributes:
        disparities: how many pixels are searched; with KITTI's cameras, 128 reach to within 3 m.
        block: side of the matched block, pixels.
        uniqueness: by how many percent the best match must beat the second.
        speckle_pixels: smaller islands of disparity are dropped.
        speckle_range: steps, in pixels, that end an island.
    """

    disparities: int = 128
    block: int = 5
    uniqueness: int = 10
    speckle_pixels: int = 100
    speckle_range: int = 2

    def description(self) -> dict[str, int]:
        """For the record beside a dataset."""
        return asdict(self)


def depth_from_stereo(
    left: Rgb, right: Rgb, *, focal_baseline_px_m: float, matching: StereoMatching = StereoMatching()
) -> Float32[NDArray[np.float32], "H W"]:
    """Match a rectified pair and turn the disparity of the left picture into depth.

    Args:
        left: sRGB.
        right: sRGB, of the camera to the right.
        focal_baseline_px_m: fx times baseline, pixels times metres.
        matching: settings.

    Returns:
        z of the left camera, metres; 0 where nothing was matched.

    StereoSGBM leaves out as many columns on the left as disparities are searched, a tenth of KITTI's pictures, although what is far
    away there has its match in the right picture. So both pictures are widened on the left, and what matches the added part is dropped.
    """
    added = matching.disparities
    wide = [cv2.copyMakeBorder(each, 0, 0, added, 0, cv2.BORDER_REPLICATE) for each in (left, right)]
    channels = left.shape[2]
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=matching.disparities,
        blockSize=matching.block,
        P1=8 * channels * matching.block**2,
        P2=32 * channels * matching.block**2,
        uniquenessRatio=matching.uniqueness,
        speckleWindowSize=matching.speckle_pixels,
        speckleRange=matching.speckle_range,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    disparity = matcher.compute(*wide)[:, added:].astype(np.float32) / _STEPS_PER_PIXEL
    disparity[disparity > np.arange(disparity.shape[1])] = 0
    depth_m = np.zeros(disparity.shape, np.float32)
    np.divide(np.float32(focal_baseline_px_m), disparity, out=depth_m, where=disparity > 0)
    return depth_m
