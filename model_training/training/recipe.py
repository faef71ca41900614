"""What the stock encoder is trained on: cities, sensors and seeds that no evaluation uses.

Each use has its own range of seeds, so that we tune nothing on what we report. A test checks that they do not overlap:
training 1000-1999, validation 2000-2999, calibration of confidence 3000-3999, evaluation 9000-9999.
The paper's city belongs to the evaluation too.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import cycle, islice

from model_training.simulation.exposure import RGBS
from model_training.simulation.plan import CameraPlan
from model_training.simulation.stereo_pair import STEREOS
from model_training.training.matched_views import MatchedRig
from model_training.training.packs import PackPlan
from model_training.training.random_rigs import HEIGHT_M, random_rigs

#: Seeds of the training cities.
TRAINING_SEEDS = range(1000, 2000)
#: Seeds of the validation cities.
VALIDATION_SEEDS = range(2000, 3000)
#: Seeds of the calibration cities.
CALIBRATION_SEEDS = range(3000, 4000)
#: Seeds of the evaluation cities.
EVALUATION_SEEDS = range(9000, 10000)

#: One LiDAR per city. So the encoder learns from 16 to 128 beams, and from sensors that do not look up.
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


#: Cities of the recipe ``stock``.
STOCK_CITIES = 26


def stock_plans(cities: int) -> list[PackPlan]:
    """Plan cities with modelled depth errors, the default of ``train``.

    Args:
        cities: number of cities.
    """
    return [PackPlan(seed=TRAINING_SEEDS[k], lidar=_LIDARS[k % len(_LIDARS)]) for k in range(cities)]


#: A machine-vision camera, its light, and its exposure in stops. It exposes for the shade, so sunlit roads clip.
_MACHINE = (RGBS["machine"], "hard_light", (-0.3, 1.0))
#: Rigs whose pairs are rendered and matched: a car's rig with two matchers, a hand-held rig and a small robot's rig.
#: The car's rig is KITTI's with half the pixels, and therefore half the rectification errors in pixels.
MATCHED_RIGS = (
    MatchedRig(
        CameraPlan(width=621, height=188, horizontal_deg=81.4).pinhole(),
        (1.5, 1.8),
        replace(STEREOS["sgbm"], focal_baseline_px_m=192.0, offset_px=0.28, vertical_px=0.2, roll_px=0.2),
        *_MACHINE,
    ),
    MatchedRig(
        CameraPlan(width=480, height=270, horizontal_deg=90.0).pinhole(),
        (1.0, 1.6),
        replace(STEREOS["sgbm"], focal_baseline_px_m=60.0, offset_px=0.2, vertical_px=0.15, roll_px=0.15),
    ),
    MatchedRig(
        CameraPlan(width=621, height=188, horizontal_deg=81.4).pinhole(),
        (1.5, 1.8),
        replace(STEREOS["sgbm3way"], focal_baseline_px_m=192.0, offset_px=0.28, vertical_px=0.2, roll_px=0.2),
    ),
    MatchedRig(
        CameraPlan(width=480, height=300, horizontal_deg=80.0).pinhole(),
        (0.7, 1.2),
        replace(STEREOS["bm"], focal_baseline_px_m=76.0, offset_px=0.22, vertical_px=0.16, roll_px=0.16),
        *_MACHINE,
    ),
)
#: LiDAR, its height (m) and kind of city, one after the other.
_SURVEYS = (
    ("hdl_64", 1.73, "mixed"),
    ("vlp_16", 1.6, "city"),
    ("hdl_32", 1.5, "mixed"),
    ("os1_64", 1.2, "mixed"),
    ("hdl_64", 1.9, "city"),
    ("pandar_64", 2.0, "mixed"),
    ("vlp_16", 1.4, "mixed"),
    ("os1_128", 1.8, "city"),
    ("hdl_64", 1.73, "mixed"),
    ("hdl_32", 1.8, "mixed"),
)
#: Places of a city with stereo-matched depth. Small packs are ready soon, so a training sees many cities.
_STREET_PLACES = 480
_CAR_LIDARS = ("hdl_64", "hdl_64", "hdl_32", "hdl_64", "os1_64")


@dataclass(frozen=True, slots=True)
class _Streets:
    """Indices of the first seeds, and numbers of cities, of one training on many small cities.

    Attributes:
        stock: cities with modelled depth, as in the stock recipe.
        low_and_high: cities with modelled depth, and cameras at 0.3 to 3.2 m.
        cars: cities with stereo-matched depth of a car's rig and of a hand-held rig.
        random: cities with stereo-matched depth of random rigs.
    """

    stock: tuple[int, int]
    low_and_high: tuple[int, int]
    cars: tuple[int, int]
    random: tuple[int, int]


_STREETS = _Streets(stock=(0, 11), low_and_high=(200, 8), cars=(300, 21), random=(400, 20))
_MORE_STREETS = _Streets(stock=(500, 11), low_and_high=(600, 7), cars=(700, 18), random=(800, 17))


def street_plans() -> list[PackPlan]:
    """Plan 60 small cities, more than half with suburbs and hedges: the first training of the stock encoder."""
    return _many_small(_STREETS)


def more_street_plans() -> list[PackPlan]:
    """Plan 53 further small cities of the same kinds: the second training of the stock encoder."""
    return _many_small(_MORE_STREETS)


def _many_small(streets: _Streets) -> list[PackPlan]:
    """Plan the cities of one training, each kind after the other."""
    first, cities = streets.stock
    stock = [replace(plan, places=1056) for plan in stock_plans(first + cities)[first:]]
    low_and_high = [
        replace(plan, places=2 * _STREET_PLACES, queries_a_place=2) for plan in _surveyed(*streets.low_and_high)
    ]
    first, cities = streets.cars
    cars = [
        PackPlan(
            seed=TRAINING_SEEDS[first + k],
            name="mixed" if k % 5 else "city",
            places=_STREET_PLACES,
            queries_a_place=1,
            lidar=_CAR_LIDARS[k % len(_CAR_LIDARS)],
            lidar_height_m=1.73,
            rigs=(MATCHED_RIGS[0], MATCHED_RIGS[2], MATCHED_RIGS[0], MATCHED_RIGS[1 if k % 2 else 3]),
        )
        for k in range(cities)
    ]
    surveyed = _surveyed(*streets.random)
    return stock + low_and_high + cars + [replace(plan, rigs=random_rigs(plan.seed, 16)) for plan in surveyed]


def _surveyed(first: int, cities: int) -> list[PackPlan]:
    """Plan cities whose LiDAR, its height and the kind of city follow ``_SURVEYS``."""
    return [
        PackPlan(
            seed=TRAINING_SEEDS[first + k],
            name=kind,
            places=_STREET_PLACES,
            queries_a_place=1,
            lidar=lidar,
            lidar_height_m=height_m,
            camera_height_m=HEIGHT_M,
        )
        for k, (lidar, height_m, kind) in enumerate(islice(cycle(_SURVEYS), cities))
    ]


def validation_plans() -> list[PackPlan]:
    """Plan the validation city of the training."""
    return [PackPlan(seed=VALIDATION_SEEDS[0], places=900, queries_a_place=1)]


def paper_plans() -> list[PackPlan]:
    """Plan the paper's city, for the encoder that is trained on it with its own traversals and vehicles."""
    return [PackPlan(seed=0, name="paper", places=2000)]


#: Recipes by name. Each gets the number of cities; only the stock recipe uses it.
RECIPES: dict[str, Callable[[int], list[PackPlan]]] = {
    "stock": stock_plans,
    "streets": lambda _: street_plans(),
    "more-streets": lambda _: more_street_plans(),
    "paper": lambda _: paper_plans(),
}
