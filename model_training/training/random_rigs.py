"""Stereo rigs with random intrinsics, heights, baselines and matchers.

A training on a few rigs serves these rigs only. With cameras of 1.2 to 1.9 m, the encoder found 58 % of the places of a rig with
a baseline of 0.08 m at 1.1 m, and 91 % of the places of a car. Random rigs cover the range between a small robot and a lorry. So no
rig of the calibration or of an evaluation is trained on as such (domain randomisation; Tobin et al., IROS 2017).
"""

import math
from dataclasses import replace

import numpy as np

from model_training.simulation.exposure import RGBS
from model_training.simulation.plan import CameraPlan
from model_training.simulation.stereo_pair import STEREOS
from model_training.training.matched_views import MatchedRig

#: Height of the camera above the ground, metres: from a delivery robot to a lorry.
HEIGHT_M = (0.3, 3.2)
#: Focal length times baseline, pixels times metres, of an image of ``WIDTH_PX`` pixels: from a baseline of 0.06 m to one of 0.6 m.
FOCAL_BASELINE_PX_M = (22.0, 210.0)
#: Horizontal field of view, degrees.
FIELD_OF_VIEW_DEG = (55.0, 110.0)
#: Image height divided by its width. KITTI's images have 0.3.
ASPECTS = (0.3, 0.5625, 0.5625, 0.625, 0.75)
#: Image width, pixels. More pixels cost more rendering; the view grid has 128 columns.
WIDTH_PX = 512
#: Rectification error per pixel of a degree, pixels: KITTI's rig has 0.55, 0.4 and 0.4 px at 15 pixels per degree.
RECTIFICATION_DEG = (0.036, 0.026, 0.026)
#: Share of rigs that remove depths beyond a limit, and the limits, metres.
LIMITED, LIMITS_M = 0.35, (12.0, 40.0)
#: Exposure above the metered one in hard light, stops.
EXPOSURE_EV = (-0.3, 1.0)


def random_rigs(seed: int, count: int) -> tuple[MatchedRig, ...]:
    """Draw rigs; every second one has a machine-vision camera in hard light.

    Args:
        seed: seed of the random generator.
        count: number of rigs.
    """
    rng = np.random.default_rng([7919, seed])
    return tuple(_random_rig(rng, hard_light=k % 2 == 0) for k in range(count))


def _random_rig(rng: np.random.Generator, *, hard_light: bool) -> MatchedRig:
    field_deg = float(rng.uniform(*FIELD_OF_VIEW_DEG))
    camera = CameraPlan(
        width=WIDTH_PX, height=16 * round(WIDTH_PX * float(rng.choice(ASPECTS)) / 16), horizontal_deg=field_deg
    )
    offset, vertical, roll = (degrees * WIDTH_PX / field_deg for degrees in RECTIFICATION_DEG)
    height_m = _log_uniform(rng, HEIGHT_M)
    model = replace(
        STEREOS[str(rng.choice(list(STEREOS)))],
        focal_baseline_px_m=_log_uniform(rng, FOCAL_BASELINE_PX_M),
        offset_px=offset,
        vertical_px=vertical,
        roll_px=roll,
    )
    if rng.random() < LIMITED:
        model = replace(model, max_range_m=float(rng.uniform(*LIMITS_M)))
    rig = MatchedRig(camera.pinhole(), (0.93 * height_m, 1.07 * height_m), model)
    if not hard_light:
        return rig
    return replace(rig, rgb=RGBS["machine"], condition="hard_light", exposure_ev=EXPOSURE_EV)


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return math.exp(rng.uniform(math.log(bounds[0]), math.log(bounds[1])))
