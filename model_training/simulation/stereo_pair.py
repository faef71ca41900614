"""Depth of a simulated stereo rig by real matching: the right picture is rendered too, and a matcher that robots run finds the disparity.

Smooth surfaces, fattened edges, streaks and holes come from matching itself. What is drawn by chance is how well the rig is rectified:
a turn of the right camera about each of its axes. Its sizes are what KITTI's pairs show against the scans (``benchmarks/real/matcher.py``).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model_training.importing.stereo import BLOCK_MATCHING, SEMI_GLOBAL, StereoMatching, depth_from_stereo
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import rotation_x, rotation_y, rotation_z, transform_from

#: Least distance that is searched, and fewest disparities.
NEAREST_M, FEWEST_DISPARITIES = 3.0, 64
#: An error of rectification is its size times a factor between these, of either sign.
SIZES = (0.6, 1.4)


@dataclass(frozen=True, slots=True)
class StereoModel:
    """A stereo rig and its matcher.

    Attributes:
        name: of the preset.
        matching: settings of the matcher, but for the disparities, which follow from the rig.
        focal_baseline_px_m: focal length times baseline, pixels times metres.
        offset_px: size of the disparity's error all over a picture: the right camera is turned about its vertical axis.
        vertical_px: size of the rows' error: it is turned about its horizontal axis.
        roll_px: size of the rows' error a quarter of the width from the middle: it is turned about its optical axis.
        min_range_m: nearer depths are dropped;
        max_range_m: and farther ones.
    """

    name: str
    matching: StereoMatching = SEMI_GLOBAL
    focal_baseline_px_m: float = 80.0
    offset_px: float = 0.55
    vertical_px: float = 0.4
    roll_px: float = 0.4
    min_range_m: float = 0.4
    max_range_m: float = 65.0


STEREOS = {
    m.name: m
    for m in (
        StereoModel("sgbm"),
        StereoModel("sgbm3way", StereoMatching("sgbm_3way", block=3, uniqueness=5)),
        StereoModel("bm", BLOCK_MATCHING),
    )
}


@dataclass(frozen=True, slots=True)
class StereoRig:
    """A stereo model on a camera, rectified as well as one drive's was.

    Attributes:
        model: with the disparities that this camera needs.
        baseline_m: between the cameras.
        T_left_right: pose of the right camera as it really is.
    """

    model: StereoModel
    baseline_m: float
    T_left_right: NDArray[np.float64]

    @staticmethod
    def drawn(model: StereoModel, camera: PinholeCamera, rng: np.random.Generator) -> "StereoRig":
        """The rig of one drive."""
        baseline_m = model.focal_baseline_px_m / camera.fx
        signs, sizes = rng.choice([-1.0, 1.0], 3), rng.uniform(*SIZES, 3)
        offset, vertical, roll = signs * sizes * [model.offset_px, model.vertical_px, model.roll_px]
        R = rotation_y(offset / camera.fx) @ rotation_x(vertical / camera.fx) @ rotation_z(roll / (camera.width / 4))
        needed = 16 * math.ceil(model.focal_baseline_px_m / NEAREST_M / 16)
        matching = replace(model.matching, disparities=max(FEWEST_DISPARITIES, needed))
        return StereoRig(replace(model, matching=matching), baseline_m, transform_from(R, np.array([baseline_m, 0, 0])))

    def depth(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Depth (z) of the left camera (H, W), metres, 0 for no measurement, as a user computes it: by the nominal geometry."""
        model = self.model
        z_m = depth_from_stereo(left, right, focal_baseline_px_m=model.focal_baseline_px_m, matching=model.matching)
        z_m[(z_m < model.min_range_m) | (z_m > model.max_range_m)] = 0
        return z_m
