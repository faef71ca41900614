"""Depth from a rectified stereo pair by the matchers that robots run.

Semi-global matching (Hirschmüller, PAMI 2008; OpenCV's StereoSGBM), and block matching (Konolige, ISRR 1997; OpenCV's StereoBM) with the
settings that ROS stereo_image_proc has by default.
"""

from dataclasses import asdict, dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

Rgb = UInt8[NDArray[np.uint8], "H W 3"]

#: StereoSGBM counts disparity in sixteenths of a pixel.
_STEPS_PER_PIXEL = 16


@dataclass(frozen=True, slots=True)
class StereoMatching:
    """Settings of a matcher; the defaults are those of the recordings' figures, penalties as OpenCV's manual advises.

    Attributes:
        method: ``sgbm`` aggregates over eight directions (MODE_HH), ``sgbm_3way`` over three, ``bm`` compares blocks alone.
        disparities: how many pixels are searched; with KITTI's cameras, 128 reach to within 3 m.
        block: side of the matched block, pixels.
        uniqueness: by how many percent the best match must beat the second.
        speckle_pixels: smaller islands of disparity are dropped.
        speckle_range: steps, in pixels, that end an island.
    """

    method: Literal["sgbm", "sgbm_3way", "bm"] = "sgbm"
    disparities: int = 128
    block: int = 5
    uniqueness: int = 10
    speckle_pixels: int = 100
    speckle_range: int = 2

    def description(self) -> dict[str, int | str]:
        """For the record beside a dataset."""
        return asdict(self)

    def matcher(self, channels: int) -> cv2.StereoMatcher:
        """OpenCV's, for pictures of so many channels (block matching takes one)."""
        if self.method == "bm":
            found = cv2.StereoBM.create(numDisparities=self.disparities, blockSize=self.block)
            found.setPreFilterType(cv2.STEREO_BM_PREFILTER_XSOBEL)
            found.setPreFilterCap(31)
            found.setTextureThreshold(10)
            found.setUniquenessRatio(self.uniqueness)
            found.setSpeckleWindowSize(self.speckle_pixels)
            found.setSpeckleRange(self.speckle_range)
            return found
        return cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self.disparities,
            blockSize=self.block,
            P1=8 * channels * self.block**2,
            P2=32 * channels * self.block**2,
            uniquenessRatio=self.uniqueness,
            speckleWindowSize=self.speckle_pixels,
            speckleRange=self.speckle_range,
            mode=cv2.STEREO_SGBM_MODE_HH if self.method == "sgbm" else cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )


SEMI_GLOBAL = StereoMatching()
#: Block matching as stereo_image_proc has it by default.
BLOCK_MATCHING = StereoMatching("bm", block=15, uniqueness=15, speckle_range=4)


def depth_from_stereo(
    left: Rgb, right: Rgb, *, focal_baseline_px_m: float, matching: StereoMatching = SEMI_GLOBAL
) -> Float32[NDArray[np.float32], "H W"]:
    """Match a rectified pair and turn the disparity of the left picture into depth.

    Args:
        left: sRGB.
        right: sRGB, of the camera to the right.
        focal_baseline_px_m: fx times baseline, pixels times metres.
        matching: settings.

    Returns:
        z of the left camera, metres; 0 where nothing was matched.

    The matchers leave out as many columns on the left as disparities are searched, a tenth of KITTI's pictures, although what is far
    away there has its match in the right picture. So both pictures are widened on the left, and what matches the added part is dropped.
    """
    added = matching.disparities
    pictures = [cv2.copyMakeBorder(each, 0, 0, added, 0, cv2.BORDER_REPLICATE) for each in (left, right)]
    if matching.method == "bm":
        pictures = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in pictures]
    matched = matching.matcher(left.shape[2]).compute(*pictures)[:, added:]
    disparity = matched.astype(np.float32) / _STEPS_PER_PIXEL
    disparity[disparity > np.arange(disparity.shape[1])] = 0
    depth_m = np.zeros(disparity.shape, np.float32)
    np.divide(np.float32(focal_baseline_px_m), disparity, out=depth_m, where=disparity > 0)
    return depth_m
