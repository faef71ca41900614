"""Gain from a correct prior, and loss from a wrong one."""

import numpy as np
from numpy.typing import NDArray

from benchmarks.plans import BOTH, unseen_plan
from benchmarks.report import Report
from benchmarks.runs import Runs, accepted_within, within
from benchmarks.sequences import between_landmarks, repeating_answers
from model_training.evaluation.predict import Predictions, PriorOf
from model_training.evaluation.priors import prior_with_std
from model_training.simulation.repeating import BLOCK_M
from service.geometry.rigid import Transform
from service.retrieval.prior import Prior

STD_M = 5.0


def aside(T_map_camera: Transform, rng: np.random.Generator) -> Prior:
    """Make a prior wrong by 10 to 25 m, two to five times its standard deviation; mostly within the same street.

    Args:
        T_map_camera: ground-truth pose (4, 4).
        rng: source of randomness.
    """
    towards = rng.uniform(0, 2 * np.pi)
    away = rng.uniform(10, 25) * np.array([np.cos(towards), np.sin(towards)])
    return Prior(position_m=T_map_camera[:2, 3] + away, position_std_m=STD_M)


def elsewhere(T_map_camera: Transform, rng: np.random.Generator) -> Prior:
    """Make a prior wrong by 60 to 120 m: in another street.

    Args:
        T_map_camera: ground-truth pose (4, 4).
        rng: source of randomness.
    """
    towards = rng.uniform(0, 2 * np.pi)
    away = rng.uniform(60, 120) * np.array([np.cos(towards), np.sin(towards)])
    return Prior(position_m=T_map_camera[:2, 3] + away, position_std_m=STD_M)


def next_block(T_map_camera: Transform, _rng: np.random.Generator) -> Prior:
    """Make a prior at the same spot of the next identical block; only the prior distinguishes the blocks.

    Args:
        T_map_camera: ground-truth pose (4, 4).
        _rng: unused.
    """
    return Prior(position_m=T_map_camera[:2, 3] + [BLOCK_M, 0.0], position_std_m=STD_M)


def at_a_place(places_m: NDArray[np.float64]) -> PriorOf:
    """Return a function that makes priors near a random place of a map, whatever the true pose: the robot is outside of the map.

    Args:
        places_m: x and y of the places (P, 2), map frame, metres.
    """

    def prior(_T_map_camera: Transform, rng: np.random.Generator) -> Prior:
        return Prior(position_m=places_m[rng.integers(len(places_m))] + rng.normal(0, STD_M, 2), position_std_m=STD_M)

    return prior


PRIORS: dict[str, PriorOf] = {"right": prior_with_std(STD_M), "aside": aside, "elsewhere": elsewhere}


def prior_rows(report: Report, runs: Runs) -> None:
    """Add the shares of correct accepted, correct forced and wrong accepted answers: no prior, correct prior, wrong priors.

    Queries of another city also send a prior inside the map. The rows ``prior.*.outside.*.accepted`` are the shares that are accepted.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    dataset = runs.dataset(unseen_plan(0))
    bundle = runs.bundle(dataset)
    for preset in BOTH:
        name = f"drive1_{preset}"
        _rows(report, f"prior.none.{preset}", runs.predictions(bundle, dataset, name))
        for kind, prior_of in PRIORS.items():
            _rows(report, f"prior.{kind}.{preset}", runs.predictions(bundle, dataset, name, prior=(kind, prior_of)))
    stranger = runs.dataset(unseen_plan(1))
    inside = at_a_place(bundle.T_map_place[:, :2, 3])
    for preset in BOTH:
        name = f"drive1_{preset}"
        for kind, prior in (("none", None), ("wrong", ("inside", inside))):
            found = runs.predictions(bundle, stranger, name, prior=prior)
            report.share(f"prior.{kind}.outside.{preset}.accepted", found.localized, better="lower")
    for kind, prior_of in (("right", PRIORS["right"]), ("next_block", next_block)):
        found = repeating_answers(runs, prior=(kind, prior_of))
        _rows(report, f"prior.{kind}.repeating", found.of(between_landmarks(found)))


def _rows(report: Report, row: str, found: Predictions) -> None:
    good = accepted_within(found, 1.0)
    report.share(f"{row}.within_1_m", good)
    report.share(f"{row}.forced_within_1_m", within(found, 1.0))
    report.share(f"{row}.wrong_and_accepted", found.localized & ~good, better="lower")
