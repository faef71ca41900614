"""Priors for evaluations, from the ground truth."""

import numpy as np

from model_training.evaluation.predict import PriorOf
from service.geometry.rigid import Transform
from service.retrieval.prior import Prior


def prior_with_std(std_m: float) -> PriorOf:
    """Return a function that makes priors of a position. Their error agrees with the standard deviation that they state.

    Args:
        std_m: standard deviation per axis, metres.
    """

    def prior(T_map_camera: Transform, rng: np.random.Generator) -> Prior:
        return Prior(position_m=T_map_camera[:2, 3] + rng.normal(0, std_m, 2), position_std_m=std_m)

    return prior
