"""Depth of a simulated stereo rig by real matching: the right image is rendered too, and a real matcher finds the disparity.

Smooth surfaces, fattened edges, streaks and holes result from the matching. Only the rectification error is drawn: a rotation of the
right camera about each of its axes. Its sizes come from KITTI's pairs against its scans (``benchmarks/real/matcher.py``).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model_training.importing.stereo import BLOCK_MATCHING, SEMI_GLOBAL, StereoMatching, depth_from_stereo
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import rotation_x, rotation_y, rotation_z, transform_from
from service.registration.points import FOCAL_BASELINE_PX_M

#: Smallest distance that the matcher searches, metres, and least number of disparities.
NEAREST_M, FEWEST_DISPARITIES = 3.0, 64
#: Range of the factor on the size of a rectification error. The sign is random.
SIZES = (0.6, 1.4)


@dataclass(frozen=True, slots=True)
class StereoModel:
    """A stereo rig and its matcher.

    Attributes:
        name: name of the preset.
        matching: settings of the matcher. The number of disparities follows from the rig instead.
        focal_baseline_px_m: focal length times baseline, pixels times metres.
        offset_px: size of the disparity offset of the whole image, pixels. It rotates the right camera about its vertical axis.
        vertical_px: size of the row offset, pixels. It rotates the right camera about its horizontal axis.
        roll_px: size of the row offset at a quarter of the width from the centre, pixels. It rotates the camera about its optical axis.
        min_range_m: smaller depths are removed, metres.
        max_range_m: larger depths are removed, metres.
    """

    name: str
    matching: StereoMatching = SEMI_GLOBAL
    focal_baseline_px_m: float = FOCAL_BASELINE_PX_M
    offset_px: float = 0.55
    vertical_px: float = 0.4
    roll_px: float = 0.4
    min_range_m: float = 0.4
    max_range_m: float = 65.0


#: Presets of stereo-matched depth by name.
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
    """A stereo model on a camera, with the rectification error of one traversal.

    Attributes:
        model: stereo model with the number of disparities that this camera needs.
        baseline_m: distance between the cameras, metres.
        T_left_right: true pose (4, 4) of the right camera in the left camera's optical frame, metres.
    """

    model: StereoModel
    baseline_m: float
    T_left_right: NDArray[np.float64]

    @staticmethod
    def drawn(model: StereoModel, camera: PinholeCamera, rng: np.random.Generator) -> "StereoRig":
        """Draw the rig of one traversal.

        Args:
            model: stereo model.
            camera: intrinsics of both cameras.
            rng: random generator of the traversal.
        """
        baseline_m = model.focal_baseline_px_m / camera.fx
        signs, sizes = rng.choice([-1.0, 1.0], 3), rng.uniform(*SIZES, 3)
        offset, vertical, roll = signs * sizes * [model.offset_px, model.vertical_px, model.roll_px]
        R = rotation_y(offset / camera.fx) @ rotation_x(vertical / camera.fx) @ rotation_z(roll / (camera.width / 4))
        needed = 16 * math.ceil(model.focal_baseline_px_m / NEAREST_M / 16)
        matching = replace(model.matching, disparities=max(FEWEST_DISPARITIES, needed))
        return StereoRig(replace(model, matching=matching), baseline_m, transform_from(R, np.array([baseline_m, 0, 0])))

    def depth(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the depth of the left camera (H, W), z in metres; 0 where nothing was matched.

        As in practice, the conversion uses the nominal geometry, not the true pose.

        Args:
            left: sRGB image (H, W, 3).
            right: sRGB image (H, W, 3) of the right camera.
        """
        model = self.model
        z_m = depth_from_stereo(left, right, focal_baseline_px_m=model.focal_baseline_px_m, matching=model.matching)
        z_m[(z_m < model.min_range_m) | (z_m > model.max_range_m)] = 0
        return z_m
