"""What the stock encoder is trained on: cities, sensors and seeds that no bar is measured on.

Seeds by use, so that nothing is tuned on what is reported (a test holds them apart): training 1000-1999, watching the
training 2000-2999, calibrating confidence 3000-3999, evaluation 9000-9999; the paper's city is evaluation too.
"""

from collections.abc import Callable
from dataclasses import replace

from model_training.simulation.exposure import RGBS
from model_training.simulation.plan import CameraPlan
from model_training.simulation.stereo_pair import STEREOS
from model_training.training.matched_views import MatchedRig
from model_training.training.packs import PackPlan

TRAINING_SEEDS = range(1000, 2000)
WATCH_SEEDS = range(2000, 3000)
CALIBRATION_SEEDS = range(3000, 4000)
EVALUATION_SEEDS = range(9000, 10000)

#: One LiDAR a city, so that the encoder meets 16 to 128 beams and sensors that do not look up.
_LIDARS = (
    "paper_32",
    "paper_32",
    "vlp_16",
    "paper_32",
    "hdl_64",
    "paper_32",
    "paper_32",
    "hdl_64",
    "paper_32",
    "os1_128",
)


STOCK_CITIES = 26


def stock_plans(cities: int) -> list[PackPlan]:
    """The training set of the stock encoder."""
    return [PackPlan(seed=TRAINING_SEEDS[k], lidar=_LIDARS[k % len(_LIDARS)]) for k in range(cities)]


#: A machine-vision camera, its light, and stops of exposure: more for the shade, so that sunlit roads clip.
_MACHINE = (RGBS["machine"], "hard_light", (-0.3, 1.0))
#: Rigs whose pairs are rendered and matched. A car's as KITTI's at half the pixels, half the errors of rectification with it, by two
#: matchers; a small robot's; and a hand-held one.
MATCHED_RIGS = (
    MatchedRig(
        CameraPlan(width=621, height=188, horizontal_deg=81.4).pinhole(), (1.5, 1.8),
        replace(STEREOS["sgbm"], focal_baseline_px_m=192.0, offset_px=0.28, vertical_px=0.2, roll_px=0.2), *_MACHINE,
    ),
    MatchedRig(
        CameraPlan(width=480, height=270, horizontal_deg=90.0).pinhole(), (1.0, 1.6),
        replace(STEREOS["sgbm"], focal_baseline_px_m=60.0, offset_px=0.2, vertical_px=0.15, roll_px=0.15),
    ),
    MatchedRig(
        CameraPlan(width=621, height=188, horizontal_deg=81.4).pinhole(), (1.5, 1.8),
        replace(STEREOS["sgbm3way"], focal_baseline_px_m=192.0, offset_px=0.28, vertical_px=0.2, roll_px=0.2),
    ),
    MatchedRig(
        CameraPlan(width=480, height=300, horizontal_deg=80.0).pinhole(), (0.7, 1.2),
        replace(STEREOS["bm"], focal_baseline_px_m=76.0, offset_px=0.22, vertical_px=0.16, roll_px=0.16), *_MACHINE,
    ),
)  # fmt: skip
#: The first seed of ``matched_plans``: after those of the stock recipe.
_MATCHED_FROM = 40
_MATCHED_LIDARS = ("hdl_64", "hdl_32", "hdl_64", "os1_64", "hdl_64")


#: Clean cities beside them in the matched recipe, so that what the encoder knows is not unlearnt.
_CLEAN_BESIDE, _MATCHED = 6, 5


def matched_plans(cities: int = _MATCHED) -> list[PackPlan]:
    """Cities of all kinds of districts whose queries have depth of matched stereo pairs."""
    return [
        PackPlan(
            seed=TRAINING_SEEDS[_MATCHED_FROM + k], name="mixed", places=1000, queries_a_place=1,
            lidar=_MATCHED_LIDARS[k % len(_MATCHED_LIDARS)], rigs=MATCHED_RIGS,
        )
        for k in range(cities)
    ]  # fmt: skip


def watch_plans() -> list[PackPlan]:
    """One city that training is watched on."""
    return [PackPlan(seed=WATCH_SEEDS[0], places=900, queries_a_place=1)]


def paper_plans() -> list[PackPlan]:
    """The paper's city itself, for the encoder that is trained on it (its own drives and vehicles)."""
    return [PackPlan(seed=0, name="paper", places=2000)]


#: Recipes by name. Each is given the number of cities, which the stock one alone uses.
RECIPES: dict[str, Callable[[int], list[PackPlan]]] = {
    "stock": stock_plans,
    "matched": lambda _: [*stock_plans(_CLEAN_BESIDE), *matched_plans()],
    "paper": lambda _: paper_plans(),
}
