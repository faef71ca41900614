"""Several frames as one query, in a street of repeating blocks."""

import numpy as np
from numpy.typing import NDArray

from benchmarks.plans import SEQUENCE, repeating_plan
from benchmarks.report import Report
from benchmarks.runs import Runs, accepted_within, within
from model_training.evaluation.predict import Predictions, PriorOf, joined
from model_training.simulation.repeating import landmarks_m

#: A sequence within the first distance of a landmark's middle passes it. Beyond the second distance it cannot see it.
PASSED_M, FAR_M = 18.0, 58.0


def between_landmarks(found: Predictions) -> NDArray[np.bool_]:
    """Return which sequences (N,) see neither a landmark nor the street's ends.

    Args:
        found: answers with ground truth.
    """
    return far_from_landmarks(found.T_true)


def far_from_landmarks(T_map_camera: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which poses (N,) see neither a landmark nor the street's ends.

    Args:
        T_map_camera: true poses (N, 4, 4), metres.
    """
    x = T_map_camera[:, 0, 3]
    away = np.abs(x[:, None] - landmarks_m()).min(axis=1)
    return np.asarray((away >= FAR_M) & (np.abs(x) < landmarks_m().max() + PASSED_M))


def repeating_answers(runs: Runs, prior: tuple[str, PriorOf] | None = None) -> Predictions:
    """Answer all sequences of the repeating street.

    Args:
        runs: simulates, builds and answers, or reuses what is kept on disk.
        prior: name of a kind of prior, and its function; None for no prior.
    """
    dataset = runs.dataset(repeating_plan())
    bundle, names = runs.bundle(dataset), dataset.query_sets(with_truth=True)
    return joined([runs.predictions(bundle, dataset, name, frames_each=SEQUENCE, prior=prior) for name in names])


def sequence_rows(report: Report, runs: Runs) -> None:
    """Add rows: sequences that pass a landmark must be right, those that see none must be AMBIGUOUS.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    found = repeating_answers(runs)
    x = found.T_true[:, 0, 3]
    away = np.abs(x[:, None] - landmarks_m()).min(axis=1)
    passed, far = away <= PASSED_M, between_landmarks(found)
    report.share("sequence.landmark.within_1_m", accepted_within(found, 1.0)[passed], bar=0.99)
    report.share("sequence.landmark.forced_within_1_m", within(found, 1.0)[passed])
    report.share("sequence.no_landmark.ambiguous", found.status[far] == "AMBIGUOUS", bar=0.95)
    report.share("sequence.no_landmark.wrong_and_accepted", (found.localized & ~accepted_within(found, 1.0))[far])
