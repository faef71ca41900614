"""Cities, surveys and rigs that the verifier is trained on: every city has a random survey and a random rig.

The verifier is a part of the confidence, so it must hold for any rig (domain randomisation; Tobin et al., IROS 2017). No rig is one of the
calibration or of an evaluation as such.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from model_training.calibration.families import HARD_LIGHT_EV
from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import (
    DepthParameters,
    RgbParameters,
    StereoParameters,
    SurveyParameters,
)
from model_training.training.random_rigs import RECTIFICATION_DEG
from model_training.training.recipe import TRAINING_SEEDS

#: Index of the seed of the first city in ``TRAINING_SEEDS``. The stock encoder was not trained on the seeds from it on (1208 to 1299).
FIRST_SEED = 208
#: Largest number of cities. The seeds after theirs are those of cities of the encoder.
MOST_CITIES = 92
#: Traversals of a city, and queries of each.
TRAVERSALS, QUERIES = 4, 40
_STREAM = 4242  # stream of the random generator
#: Position of the first city in the lists of presets below.
_FIRST_NUMBER = 8
#: Presets of the LiDAR, and kinds of depth. One that is listed twice occurs twice as often.
_LIDARS = (
    "hdl_64", "vlp_16", "hdl_32", "os1_64", "pandar_64", "os1_128", "livox_mid_360", "hdl_64", "vlp_16", "paper_32",
)  # fmt: skip
_DEPTHS = ("sgbm", "precise", "bm", "stereo", "sgbm3way", "sgbm", "precise", "sgbm3way", "monocular", "sgbm")
_KINDS = ("mixed", "city", "mixed")
_FIELD_DEG = (50.0, 112.0)
_WIDTHS_PX, _SMALL_WIDTHS_PX, _WIDE_PX = (512, 640, 640, 800, 1242), (512, 640), 1242
_ASPECTS, _WIDE_ASPECT, _PORTRAIT = (0.3, 0.5625, 0.5625, 0.625, 0.75, 0.75), 0.3, 1.3
_PORTRAIT_BELOW_DEG = 75.0  # only a narrow camera is held upright
_HEIGHT_M = (0.25, 3.4)


def verification_plan(index: int) -> SimulationPlan:
    """Plan a training city of the verifier.

    Args:
        index: number of the city, from 0.

    Raises:
        ValueError: there is no city of this number.
    """
    if not 0 <= index < MOST_CITIES:
        raise ValueError(f"index: {index} is not between 0 and {MOST_CITIES - 1}")
    seed, number = TRAINING_SEEDS[FIRST_SEED + index], _FIRST_NUMBER + index
    rng = np.random.default_rng([_STREAM, seed])
    depth = _DEPTHS[number % len(_DEPTHS)]
    field_deg = float(rng.uniform(*_FIELD_DEG))
    width = int(rng.choice(_SMALL_WIDTHS_PX if depth == "monocular" else _WIDTHS_PX))
    portrait = _PORTRAIT if field_deg < _PORTRAIT_BELOW_DEG else 0.6
    aspect = float(rng.choice([*_ASPECTS, portrait]))
    aspect = _WIDE_ASPECT if width == _WIDE_PX else aspect
    camera = CameraPlan(width=width, height=16 * round(width * aspect / 16), horizontal_deg=field_deg)
    height_m = _log_uniform(rng, *_HEIGHT_M)
    stereo, modelled, preset = _SENSORS.get(depth, _matched)(rng, camera)
    spacing_m = float(rng.choice([1, 1, 1.5, 2, 2.5, 3.5, 5]))
    survey = SurveyParameters(
        position_m=float(rng.choice([0.03, 0.04, 0.08])),
        angle_deg=0.1,
        speed_m_s=float(rng.choice([1.5, 5, 10])),
        followed=float(rng.choice([0, 0, 0.1, 0.3])),
    )
    lidar_height_m = float(rng.uniform(1.2, 2.1))
    return SimulationPlan(
        name=f"verification-{index}",
        city=_KINDS[number % len(_KINDS)],
        seed=seed,
        size_m=(180.0, 220.0),
        # Ten cities have all LiDARs, and the next ten have each LiDAR with another kind of depth.
        lidar=_LIDARS[(7 * number + number // len(_LIDARS)) % len(_LIDARS)],
        lidar_height_m=lidar_height_m,
        spacing_m=spacing_m,
        camera=camera,
        camera_height_m=height_m,
        queries=tuple(
            _traversal(k, preset or depth, stereo, modelled, survey.followed or 0.0) for k in range(1, TRAVERSALS + 1)
        ),
        survey_parameters=survey,
    )


def _traversal(
    number: int, depth: str, stereo: StereoParameters, modelled: DepthParameters, followed: float
) -> QueryPlan:
    """Plan a traversal. Every second one is in hard light, where images clip."""
    own: dict[str, Any] = {
        "name": f"drive{number}", "traversal": number, "count": QUERIES, "depths": (depth,), "stereo_parameters": stereo,
        "depth_parameters": modelled, "aside_m": 1.5, "heading_deg": 10.0, "followed": followed,
    }  # fmt: skip
    if number % 2 == 0:
        light = RgbParameters(exposure_ev=HARD_LIGHT_EV[number // 2 % len(HARD_LIGHT_EV)])
        own |= {"condition": "hard_light", "rgb": "machine", "rgb_parameters": light}
    return QueryPlan.model_validate(own)


#: Parameters of matched stereo, of modelled depth, and the depth preset if it is not named like the kind of depth.
_Sensor = tuple[StereoParameters, DepthParameters, str | None]


def _matched(rng: np.random.Generator, camera: CameraPlan) -> _Sensor:
    """Draw a stereo rig whose pairs are rendered and matched. An image of 640 pixels and 90 degrees has a baseline of 0.09 to 0.72 m."""
    field_deg, width = camera.horizontal_deg, camera.width
    focal_baseline_px_m = _log_uniform(rng, 28, 230) * (width / 640) * (90 / field_deg) ** 0.5
    offset, vertical, roll = (share * (width / field_deg) * rng.uniform(0.6, 1.2) for share in RECTIFICATION_DEG)
    limit = {"max_range_m": float(rng.uniform(10, 40))} if rng.random() < 0.35 else {}
    stereo = StereoParameters.model_validate(
        {"focal_baseline_px_m": focal_baseline_px_m, "offset_px": offset, "vertical_px": vertical, "roll_px": roll, **limit}
    )  # fmt: skip
    return stereo, DepthParameters(), None


def _precise(rng: np.random.Generator, _camera: CameraPlan) -> _Sensor:
    """Draw a depth camera with little noise. Six of ten have a range of 7 to 30 m, and the others have no limit."""
    own = {
        "focal_baseline_px_m": _log_uniform(rng, 20, 250),
        "noise_px": float(rng.uniform(0.05, 0.2)),
        "offset_px": float(rng.uniform(0, 0.03)),
    }
    if rng.random() < 0.6:
        own["max_range_m"] = _log_uniform(rng, 7, 30)
    return StereoParameters(), DepthParameters.model_validate(own), None


def _modelled_stereo(rng: np.random.Generator, _camera: CameraPlan) -> _Sensor:
    """Draw a stereo rig whose errors a model draws."""
    return StereoParameters(), DepthParameters(focal_baseline_px_m=_log_uniform(rng, 35, 120)), None


def _monocular(rng: np.random.Generator, _camera: CameraPlan) -> _Sensor:
    """Draw a network for monocular depth: dense and smooth, with an error of scale."""
    modelled = DepthParameters(
        focal_baseline_px_m=float(rng.uniform(60, 110)), noise_px=0.8, correlated=0.95, step_px=0.0,
        scale_error=float(rng.uniform(0.03, 0.1)), bleeding=0.9, hole_level=99.0,
    )  # fmt: skip
    return StereoParameters(), modelled, "precise"


_SENSORS: dict[str, Callable[[np.random.Generator, CameraPlan], _Sensor]] = {
    "precise": _precise,
    "stereo": _modelled_stereo,
    "monocular": _monocular,
}


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))
