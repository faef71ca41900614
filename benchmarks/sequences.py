"""Several frames as one question: a street of repeating blocks."""

import numpy as np
from numpy.typing import NDArray

from benchmarks.plans import SEQUENCE, repeating_plan
from benchmarks.report import Report
from benchmarks.runs import Runs, accepted_within
from model_training.evaluation.predict import Predictions, PriorOf, joined
from model_training.simulation.repeating import landmarks_m

PASSED_M, FAR_M = 18.0, 58.0  # a landmark's middle this near is passed; so far away it cannot be seen


def between_landmarks(found: Predictions) -> NDArray[np.bool_]:
    """Sequences that see no landmark and not the street's ends, which tell where they are."""
    x = found.T_true[:, 0, 3]
    away = np.abs(x[:, None] - landmarks_m()).min(axis=1)
    return np.asarray((away >= FAR_M) & (np.abs(x) < landmarks_m().max() + PASSED_M))


def repeating_answers(runs: Runs, prior: tuple[str, PriorOf] | None = None) -> Predictions:
    """To all sequences of the street that repeats."""
    dataset = runs.dataset(repeating_plan())
    bundle, names = runs.bundle(dataset), dataset.query_sets(with_truth=True)
    return joined([runs.predictions(bundle, dataset, name, frames_each=SEQUENCE, prior=prior) for name in names])


def sequence_rows(report: Report, runs: Runs) -> None:
    """Sequences that pass a landmark are told apart, those that pass none are said to be ambiguous."""
    found = repeating_answers(runs)
    x = found.T_true[:, 0, 3]
    away = np.abs(x[:, None] - landmarks_m()).min(axis=1)
    passed, far = away <= PASSED_M, between_landmarks(found)
    report.share("sequence.landmark.within_1_m", accepted_within(found, 1.0)[passed], bar=0.99)
    report.share("sequence.no_landmark.ambiguous", found.status[far] == "AMBIGUOUS", bar=0.95)
    report.share("sequence.no_landmark.wrong_and_accepted", (found.localized & ~accepted_within(found, 1.0))[far])
