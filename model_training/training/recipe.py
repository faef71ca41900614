"""What the stock encoder is trained on: cities, sensors and seeds that no bar is measured on.

Seeds by use, so that nothing is tuned on what is reported (a test holds them apart): training 1000-1999, watching the
training 2000-2999, calibrating confidence 3000-3999, evaluation 9000-9999; the paper's city is evaluation too.
"""

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


def stock_plans(cities: int) -> list[PackPlan]:
    """The training set of the stock encoder."""
    return [PackPlan(seed=TRAINING_SEEDS[k], lidar=_LIDARS[k % len(_LIDARS)]) for k in range(cities)]


def watch_plans() -> list[PackPlan]:
    """One city that training is watched on."""
    return [PackPlan(seed=WATCH_SEEDS[0], places=900, queries_a_place=1)]


def paper_plans() -> list[PackPlan]:
    """The paper's city itself, for the encoder that is trained on it (its own drives and vehicles)."""
    return [PackPlan(seed=0, name="paper", places=2000)]
