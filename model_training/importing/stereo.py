"""Compute depth from a rectified stereo pair with the matchers that robots use.

They are semi-global matching (Hirschmüller, PAMI 2008; OpenCV's StereoSGBM) and block matching (Konolige, ISRR 1997;
OpenCV's StereoBM). Block matching has the default settings of ROS stereo_image_proc.
"""

from dataclasses import asdict, dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

Rgb = UInt8[NDArray[np.uint8], "H W 3"]

#: Steps per pixel of OpenCV's integer disparity.
_STEPS_PER_PIXEL = 16


@dataclass(frozen=True, slots=True)
class StereoMatching:
    """Settings of a matcher; penalties follow OpenCV's manual.

    Attributes:
        method: ``sgbm`` aggregates over eight directions (MODE_HH), ``sgbm_3way`` over three, ``bm`` only compares blocks.
        disparities: searched disparities, pixels; with KITTI's cameras 128 reach to within 3 m.
        block: side of the matched block, pixels.
        uniqueness: margin of the best match over the second, percent.
        speckle_pixels: islands of disparity with fewer pixels are removed.
        speckle_range: difference of disparity that ends an island, pixels.
        prefilter: largest horizontal gradient that counts, in OpenCV's units; 0 for OpenCV's default. Block matching needs it.
    """

    method: Literal["sgbm", "sgbm_3way", "bm"] = "sgbm"
    disparities: int = 128
    block: int = 5
    uniqueness: int = 10
    speckle_pixels: int = 100
    speckle_range: int = 2
    prefilter: int = 0

    def description(self) -> dict[str, int | str]:
        """Return the settings for the description of a dataset."""
        return asdict(self)

    def matcher(self, channels: int) -> cv2.StereoMatcher:
        """Make OpenCV's matcher.

        Args:
            channels: channels of the images; block matching takes one.
        """
        if self.method == "bm":
            found = cv2.StereoBM.create(numDisparities=self.disparities, blockSize=self.block)
            found.setPreFilterType(cv2.STEREO_BM_PREFILTER_XSOBEL)
            found.setPreFilterCap(self.prefilter)
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
            preFilterCap=self.prefilter,
            uniquenessRatio=self.uniqueness,
            speckleWindowSize=self.speckle_pixels,
            speckleRange=self.speckle_range,
            mode=cv2.STEREO_SGBM_MODE_HH if self.method == "sgbm" else cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )


#: Semi-global matching with OpenCV's defaults, for simulated robots.
SEMI_GLOBAL = StereoMatching()
#: Semi-global matching of recordings. The prefilter is that of OpenCV's example; it limits the weight of strong edges (decision 0176).
RECORDED = StereoMatching(prefilter=63)
#: Block matching with the default settings of stereo_image_proc.
BLOCK_MATCHING = StereoMatching("bm", block=15, uniqueness=15, speckle_range=4, prefilter=31)


def depth_from_stereo(
    left: Rgb, right: Rgb, *, focal_baseline_px_m: float, matching: StereoMatching = RECORDED
) -> Float32[NDArray[np.float32], "H W"]:
    """Match a rectified pair, and convert the disparity of the left image to depth.

    OpenCV's matchers skip as many columns on the left as disparities are searched: a tenth of KITTI's images. Distant objects
    there do have a match in the right image. So both images are padded on the left, and matches in the padding are dropped
    (decision 0127).

    Args:
        left: sRGB.
        right: sRGB, of the camera on the right.
        focal_baseline_px_m: fx times baseline, pixels times metres.
        matching: settings of the matcher.

    Returns:
        z of the left camera, metres; 0 where nothing was matched.
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
